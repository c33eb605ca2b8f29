"""Sample n of a mixture: a pure function of (config, seed, n), whoever draws it and when."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol, runtime_checkable

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.augmentation import augment
from poem_jax.data.augmentation_recipes import Recipe
from poem_jax.data.frames import CorruptSampleError, DamagedSource, FrameSource
from poem_jax.data.pictures import Decoder, decoder
from poem_jax.data.view_sampling import AllViews
from poem_jax.mixture.config import MixtureConfig, SyntheticSource, ViewSampling
from poem_jax.mixture.held_out import hold_out
from poem_jax.mixture.schedule import Schedule, frame_at
from poem_jax.synthetic.config import SyntheticConfig

if TYPE_CHECKING:
    from poem_jax.synthetic.dataset import SyntheticDataset

MAX_TRIES = 50
"""Corrupt frames in a row, one after another in a part's order, before the part is given up."""
_CHANCE = 2003
"""Last part of a sample's seed; those of `schedule.py` are others."""


class Skipped(NamedTuple):
    """A corrupt sample that another one stands for."""

    part: int
    key: str
    problem: str
    """The whole message: file, key, what is wrong."""


class Drawn(NamedTuple):
    """A sample and what was passed over on the way to it."""

    sample: MultiViewBatch
    """Without batch axis."""
    part: int
    index: int
    """Of the sample in its part."""
    skipped: tuple[Skipped, ...] = ()


class LeftOut(NamedTuple):
    """What a part lacked when it was opened."""

    samples: int
    """Those it has."""
    lost: int = 0
    """About how many more it should have."""
    problems: tuple[str, ...] = ()
    """One a damaged file or sample."""


@runtime_checkable
class Samples(Protocol):
    """A part of the mixture, with its own way from a number to a sample."""

    @property
    def name(self) -> str:
        """In logs, reports and errors."""
        ...

    def frame(self, seed: int, part: int, number: int, attempt: int) -> int:
        """Return the index of the part's sample `number`."""
        ...

    def sample(self, index: int, most_views: int, rng: np.random.Generator) -> MultiViewBatch:
        """Draw views and augment.

        Raises: CorruptSampleError
        """
        ...

    def key(self, index: int) -> str:
        """Return by what the part's user knows a sample."""
        ...

    def fingerprint(self) -> dict[str, str]:
        """Return what identifies the files."""
        ...

    def left_out(self) -> LeftOut:
        """Return what was found missing when the part was opened."""
        ...


@dataclass
class FrameSamples:
    """Frames of a data set, augmented."""

    source: FrameSource
    views: ViewSampling
    recipe: Recipe
    image_hw: tuple[int, int]
    pose: bool
    decoder: Decoder | None = None
    """None = OpenCV."""

    @property
    def name(self) -> str:
        """The source's."""
        return self.source.name

    def frame(self, seed: int, part: int, number: int, attempt: int) -> int:
        """Go through all frames, in an order that every epoch draws anew."""
        return frame_at(seed, part, number, len(self.source), attempt)

    def sample(self, index: int, most_views: int, rng: np.random.Generator) -> MultiViewBatch:
        """Read a frame, draw its views, augment.

        Raises:
            CorruptSampleError: the frame cannot be used.
            ValueError: it has no pose, and the mixture's samples must.
        """
        frame = self.source[index]
        chosen = self.views.draw(len(frame.images), rng, most_views)
        sample = augment(frame, chosen, self.recipe, self.image_hw, rng, self.decoder)
        return _with_or_without_pose(sample, self.pose, f"sample {frame.key} of {self.name}")

    def key(self, index: int) -> str:
        """Return the frame's key."""
        return self.source[index].key

    def fingerprint(self) -> dict[str, str]:
        """Return that of the source."""
        return dict(self.source.fingerprint())

    def left_out(self) -> LeftOut:
        """Return what the source says of it, where it opens although files are damaged."""
        if not isinstance(self.source, DamagedSource):
            return LeftOut(len(self.source))
        faults = tuple(str(fault) for fault in self.source.faults)
        return LeftOut(len(self.source), self.source.lost_samples, faults)


class SyntheticSamples:
    """Endless captures drawn on the fly; the index is the sample's number."""

    def __init__(self, config: SyntheticConfig, seed: int, views: ViewSampling, pose: bool) -> None:
        self.name = "synthetic captures"
        self._config, self._seed, self._views, self._pose = config, seed, views, pose
        self._dataset: SyntheticDataset | None = None

    def __getstate__(self) -> dict:
        # A worker draws the backgrounds itself: they weigh more than the rest of what it is sent.
        return {**self.__dict__, "_dataset": None}

    def frame(self, seed: int, part: int, number: int, attempt: int) -> int:
        """Return the number: no sample comes twice, and none is corrupt."""
        return number

    def sample(self, index: int, most_views: int, rng: np.random.Generator) -> MultiViewBatch:
        """Draw a capture with as many views as the part's draw has."""
        if self._dataset is None:
            # The renderer's Numba takes most of a worker's start, and few mixtures have captures.
            from poem_jax.synthetic.dataset import SyntheticDataset

            self._dataset = SyntheticDataset(self._config, self._seed)
        count = len(self._views.draw(self._config.num_views, rng, most_views))
        return _with_or_without_pose(self._dataset.sample(index, count), self._pose, self.name)

    def key(self, index: int) -> str:
        """Return the number."""
        return str(index)

    def fingerprint(self) -> dict[str, str]:
        """Return nothing: the config says it all."""
        return {}

    def left_out(self) -> LeftOut:
        """Return nothing, of a number without end."""
        return LeftOut(2**62)


class Mixture:
    """All parts, opened. Can be pickled: worker processes get it whole."""

    def __init__(
        self,
        parts: list[Samples],
        shares: tuple[float, ...],
        seed: int,
        held_out: Mapping[int, FrameSamples] | None = None,
    ) -> None:
        """Take the parts, and by a part's number the frames that it holds out."""
        self.parts, self.seed = parts, seed
        self._schedule, self._held_out = Schedule(shares, seed), held_out or {}

    def __getstate__(self) -> dict:
        # Workers draw what is trained on.
        return {**self.__dict__, "_held_out": {}}

    @property
    def held_out(self) -> dict[str, FrameSamples]:
        """What is validated on, by the part's name: all views, nothing augmented."""
        names = self.names
        return {names[part]: frames for part, frames in self._held_out.items()}

    @property
    def names(self) -> list[str]:
        """Names of the parts, each once: a second one of the same name has its number behind it."""
        names = [part.name for part in self.parts]
        return [
            name if names.index(name) == i else f"{name} ({names[: i + 1].count(name)})"
            for i, name in enumerate(names)
        ]

    def draw(self, position: int, most_views: int) -> Drawn:
        """Return the sample at a position of the stream, with at most `most_views` views.

        A corrupt frame is passed over: the next one of the same part, in this epoch's order, stands for it.

        Raises:
            ValueError: fifty corrupt frames in a row.
        """
        part, number = self._schedule.at(position)
        samples, skipped = self.parts[part], []
        for attempt in range(MAX_TRIES):
            index = samples.frame(self.seed, part, number, attempt)
            rng = np.random.default_rng((self.seed, part, number, attempt, _CHANCE))
            try:
                sample = samples.sample(index, most_views, rng)
            except CorruptSampleError as error:
                skipped.append(Skipped(part, error.key, str(error)))
                continue
            return Drawn(sample, part, index, tuple(skipped))
        raise ValueError(
            f"{MAX_TRIES} samples of {samples.name} in a row are corrupt; the last one: {skipped[-1].problem}"
        )

    def key_at(self, position: int, most_views: int) -> str:
        """Return the part and the key of the sample that `draw` gives: `dexycb 000/0001234`."""
        drawn = self.draw(position, most_views)
        return f"{self.names[drawn.part]} {self.parts[drawn.part].key(drawn.index)}"

    def fingerprint(self) -> dict[str, dict[str, str]]:
        """Return what identifies the files of every part, by the part's name."""
        return {name: part.fingerprint() for name, part in zip(self.names, self.parts, strict=True)}


def open_mixture(
    config: MixtureConfig, *, synthetic: SyntheticConfig, seed: int, image_hw: tuple[int, int]
) -> Mixture:
    """Open all sources.

    Args:
        config: parts and recipe.
        synthetic: the captures of a `SyntheticSource`.
        seed: of everything that is drawn.
        image_hw: size of the crops.

    Raises:
        FileNotFoundError: a root, a split's file, or MANO is missing.
        ModuleNotFoundError: the config's decoder is not installed.
        ValueError: a source is empty or its files are not what they should be.
    """
    chosen = decoder(config.decoder.value)
    parts: list[Samples] = []
    held_out: dict[int, FrameSamples] = {}
    for number, part in enumerate(config.parts):
        if isinstance(part.source, SyntheticSource):
            parts.append(SyntheticSamples(synthetic, seed, part.views, config.pose))
            continue
        source = part.source.open()
        if not len(source):
            raise ValueError(f"{source.name} has no sample: {part.source}")
        if part.held_out:
            source, rest = hold_out(source, part.held_out)
            plain = config.recipe.without_jitter()
            held_out[number] = FrameSamples(rest, AllViews(), plain, image_hw, config.pose, chosen)
        parts.append(FrameSamples(source, part.views, config.recipe, image_hw, config.pose, chosen))
    return Mixture(parts, config.shares, seed, held_out)


def _with_or_without_pose(sample: MultiViewBatch, pose: bool, name: str) -> MultiViewBatch:
    """Give all samples the same fields, so that they stack."""
    if not pose:
        return sample._replace(pose=None, shape=None)
    if sample.pose is None or sample.shape is None:
        raise ValueError(
            f"{name} has no pose or shape, which `mixture.pose` asks for: give its source the MANO file, "
            "leave it out, or train a model that predicts vertices with `mixture.pose` off"
        )
    return sample
