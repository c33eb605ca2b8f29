"""Which views of a frame a sample is made of, and in which order; the first becomes the world.

Every rule draws indices into the frame's views from a given generator, so that a sample depends on nothing
but its seed.
"""

import re
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from poem_jax.typing import Array, Int

RELEASE_MEAN, RELEASE_SPREAD = 4.0, 2.0
"""Of the number of views in POEM v2's released reader."""


@runtime_checkable
class ViewSampling(Protocol):
    """A rule by which views are drawn."""

    def draw(
        self, num_views: int, rng: np.random.Generator, most: int | None = None
    ) -> Int[Array, " chosen"]:
        """Return indices below `num_views`, each at most once; the first is the primary view.

        Args:
            num_views: of the frame.
            rng: chance.
            most: there is room for so many only. Numbers of views are drawn for that, and not cut to it:
                else most samples would have `most`.
        """
        ...


@dataclass(frozen=True)
class UniformViews:
    """Each number of views from `min` to `max` as often, in random order (the paper says no more than that
    they are drawn at random)."""

    min: int = 1
    max: int | None = None
    """None = all that the frame has. A frame with fewer has its own number as the largest."""

    def __post_init__(self) -> None:
        _check_range(self.min, self.max)

    def draw(
        self, num_views: int, rng: np.random.Generator, most: int | None = None
    ) -> Int[Array, " chosen"]:
        """Draw; see `ViewSampling`."""
        high = min(limit for limit in (self.max, num_views, most) if limit is not None)
        order = rng.permutation(num_views)
        return order[: rng.integers(min(self.min, high), high, endpoint=True)]


@dataclass(frozen=True)
class ReleaseNormalViews:
    """POEM v2's released rule: a rounded N(4, 2), held to `low` .. `high`, then to what there is and has
    room, in random order.

    Its evaluations with n views are `ReleaseNormalViews(n, n)`: order and primary view are random there too.
    """

    low: int
    high: int

    def __post_init__(self) -> None:
        _check_range(self.low, self.high)

    def draw(
        self, num_views: int, rng: np.random.Generator, most: int | None = None
    ) -> Int[Array, " chosen"]:
        """Draw; see `ViewSampling`."""
        order = rng.permutation(num_views)
        count = min(max(round(rng.normal(RELEASE_MEAN, RELEASE_SPREAD)), self.low), self.high)
        return order[: count if most is None else min(count, most)]


@dataclass(frozen=True)
class AllViews:
    """POEM v1's rule: all views in the frame's own order, whose first is the constant master."""

    def draw(
        self, num_views: int, rng: np.random.Generator, most: int | None = None
    ) -> Int[Array, " chosen"]:
        """Return all, or the first `most`; nothing is drawn."""
        return np.arange(num_views if most is None else min(num_views, most))


@dataclass(frozen=True)
class FixedViews:
    """The first `count` views in the frame's own order, or all where it has fewer."""

    count: int

    def __post_init__(self) -> None:
        _check_range(self.count, None)

    def draw(
        self, num_views: int, rng: np.random.Generator, most: int | None = None
    ) -> Int[Array, " chosen"]:
        """Return the first ones; nothing is drawn."""
        return AllViews().draw(min(self.count, num_views), rng, most)


def cameras_named(text: str) -> "AllViews | FixedViews | UniformViews":
    """Return the rule that an option names: `all`, `4` (the first four), `random` (all, in random order),
    `random:4`, `random:2-8`.

    Raises:
        ValueError: it names none.
    """
    form = re.fullmatch(r"(all)|(\d+)|random(?::(\d+)(?:-(\d+))?)?", text.strip())
    if form is None:
        raise ValueError(
            f"cameras are `all`, `4` (the first four), `random`, `random:4` or `random:2-8`; got {text!r}"
        )
    everything, first, low, high = form.groups()
    if everything:
        return AllViews()
    if first:
        return FixedViews(int(first))
    return UniformViews(_EVERY) if low is None else UniformViews(int(low), int(high or low))


def cameras_in_words(rule: ViewSampling) -> str:
    """Say in a few words which cameras a rule takes."""
    match rule:
        case FixedViews(count):
            return f"the first {count}"
        case UniformViews(low, None) if low >= _EVERY:
            return "all, in random order"
        case UniformViews(low, high) if low == high:
            return f"{low} at random"
        case UniformViews(low, high):
            return f"{low} to {'all' if high is None else high} at random"
        case ReleaseNormalViews(low, high):
            return f"N(4, 2) held to {low}..{high}, at random"
        case _:
            return "all"


_EVERY = 2**16
"""More views than any frame has."""


def _check_range(low: int, high: int | None) -> None:
    if low < 1 or (high is not None and high < low):
        raise ValueError(f"numbers of views must be at least 1, the larger one last; got {low} to {high}")
