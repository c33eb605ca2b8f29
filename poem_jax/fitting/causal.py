"""A filter that looks back only, for hands seen one moment after the other: the live picture's.

The hand x follows what is seen, y, by a share of the way that depends on the time dt since the last moment
and on how far it is, in the mean over the last moments, over which noise cancels and a motion does not:

    m <- (1 - b) m + b (y - x),   v <- (1 - b)^2 v + b^2,   b = 1 - exp(-dt / T_m),
    x <- x + (1 - exp(-dt / T)) (y - x),   1 / T = (1 + e max(0, d^2 / (a v s^2) - 1)) / T_0,

d^2 the mean square of a joint's coordinate of m, s the noise of what is seen from one moment to the next,
measured on the way, and v s^2 thus that of m. What noise explains is averaged over T_0; what it does not is
motion, and followed at once (the idea of the One-Euro filter of Casiez et al. 2012, which asks the speed, and
does not know its own noise). The hand never leaves the way between what it was and what is seen: it does not
overshoot.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Generic

import numpy as np

from poem_jax.fitting.moving_hands import Hand
from poem_jax.typing import Array, Float


@dataclass(frozen=True)
class FilterConfig:
    """How a hand follows what is seen of it."""

    rest_s: float = 0.25
    """T_0: how long what noise explains is averaged, seconds."""
    trend_s: float = 0.08
    """T_m: over how long a motion must show, seconds."""
    eagerness: float = 3.0
    """e: how much quicker what noise does not explain is followed."""
    allowance: float = 3.0
    """a: how many times the variance of the noise counts as noise; no less than 1."""
    noise_m: float = 0.005
    """s is never taken to be more, metres, where an engine does not say itself."""
    gap_s: float = 0.2
    """After a longer time without the hand the filter begins anew, seconds."""


class CausalFilter(Generic[Hand]):
    """The filter of one hand; moments may be spaced unevenly."""

    def __init__(self, config: FilterConfig = FilterConfig()) -> None:
        self._config = config
        self._noise = FrameNoise()
        self._state: tuple[float, Hand] | None = None
        self._trend: tuple[Array, float] = np.zeros(3), 0.0
        self.noise_m = config.noise_m
        """The noise s that was last taken, metres."""

    def update(self, time_s: float, seen: Hand, most_noise_m: float | None = None) -> Hand:
        """Take in what is seen at a moment; return the hand then.

        Args:
            time_s: The moment, seconds, later than that of the last update.
            seen: The hand as it is seen.
            most_noise_m: Standard deviation of one coordinate of a joint, as far as the engine states it: the
                noise is never taken to be more. None = `FilterConfig.noise_m`.

        Raises:
            ValueError: The moment is not later than the last one.
        """
        config = self._config
        most = config.noise_m if most_noise_m is None else most_noise_m
        state = self._state
        if state is not None and not time_s > state[0]:
            raise ValueError(f"moments must come later and later; got {time_s} s after {state[0]} s")
        if state is None or time_s - state[0] > config.gap_s + 1e-6:
            self._noise = FrameNoise()
            self._trend = np.zeros(3), 0.0
            self.noise_m = min(most, self._noise.update(time_s, seen.markers))
            self._state = time_s, seen
            return seen
        last_s, hand = state
        self.noise_m = min(most, self._noise.update(time_s, seen.markers))
        share = self._share(time_s - last_s, seen.markers - hand.markers)
        self._state = time_s, hand.towards(seen, share)
        return self._state[1]

    def _share(self, step_s: float, away: Float[Array, "joint 3"]) -> float:
        """Return how far to go towards what is seen, and how far away it is."""
        config = self._config
        new = 1 - math.exp(-step_s / config.trend_s)
        mean, variance = self._trend
        mean, variance = (1 - new) * mean + new * away, (1 - new) ** 2 * variance + new**2
        self._trend = mean, variance
        explained = config.allowance * variance * self.noise_m**2
        excess = max(0.0, float(np.mean(mean**2)) / explained - 1) if explained > 0 else math.inf
        return 1 - math.exp(-step_s * (1 + config.eagerness * excess) / config.rest_s)


class FrameNoise:
    """How much joints tremble from moment to moment: the median over the last second or so.

    Each moment is compared with the straight way between its neighbours, whose length does not matter; what
    the motion bends in so short a time counts as noise, and the median passes over it as far as it is rare.
    """

    _MOMENTS = 30
    _ENOUGH = 5

    def __init__(self) -> None:
        self._last: deque[tuple[float, Array]] = deque(maxlen=3)
        self._noise: deque[float] = deque(maxlen=self._MOMENTS)

    def update(self, time_s: float, joints: Float[Array, "joint 3"]) -> float:
        """Take in a moment; return the standard deviation of one coordinate, infinite as long as unknown."""
        self._last.append((time_s, joints))
        if len(self._last) == 3:
            residual, variance = bend(*self._last)
            self._noise.append(math.sqrt(float(np.mean(residual**2)) / variance))
        return float(np.median(self._noise)) if len(self._noise) >= self._ENOUGH else math.inf


def bend(
    first: tuple[float, Array], middle: tuple[float, Array], last: tuple[float, Array]
) -> tuple[Float[Array, "*batch 3"], float]:
    """Return how far the joints in the middle of three moments (seconds, joints) lie off the straight way.

    And the variance of this if that of every coordinate is 1, and no more moves than noise.
    """
    share = (middle[0] - first[0]) / (last[0] - first[0])
    off = middle[1] - ((1 - share) * first[1] + share * last[1])
    return off, 1 + (1 - share) ** 2 + share**2
