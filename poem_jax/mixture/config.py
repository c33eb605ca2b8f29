"""What a run is trained on: data sets with weights, as frozen dataclasses, one a kind of source.

`open()` makes the source; each imports its reader only then, so a config costs nothing to have. This file,
like all of `mixture/`, loads no JAX: worker processes get what is opened here.
"""

import enum
from dataclasses import dataclass
from typing import TypeAlias

from poem_jax.data.augmentation_recipes import PAPER, Recipe
from poem_jax.data.frames import FrameSource
from poem_jax.data.view_sampling import AllViews, FixedViews, ReleaseNormalViews, UniformViews

ViewSampling: TypeAlias = UniformViews | ReleaseNormalViews | AllViews | FixedViews

LEAST_SHARE = 0.001
"""Of a part with a weight: the mixture is exact over every thousand samples."""


@dataclass(frozen=True)
class ReleasedTarsSource:
    """The authors' packed shards of one data set, or those of `poem pack`."""

    paths: tuple[str, ...]
    """Files, folders, or patterns such as `DexYCB_mv_train-{000000..000019}.tar`."""
    split: str | None = None
    """None = what the files' names say."""
    mano: str | None = None
    """MANO_RIGHT.pkl, for sets whose labels leave MANO's mean pose out; without it they have no pose."""

    def open(self) -> FrameSource:
        """Index the shards, or read their cached index."""
        from poem_jax.data.sources.released_tars import ReleasedTars

        return ReleasedTars(self.paths, split=self.split, mano=self.mano)


@dataclass(frozen=True)
class DexYCBSource:
    """Raw DexYCB."""

    root: str
    mano: str
    """MANO_RIGHT.pkl."""
    split: str = "train"
    setup: str = "s0"

    def open(self) -> FrameSource:
        """List the frames of the split."""
        from poem_jax.data.sources.dexycb import DexYCB

        return DexYCB(self.root, split=self.split, setup=self.setup, mano=self.mano)


@dataclass(frozen=True)
class HO3DSource:
    """Raw HO-3D, its multi-view sequences."""

    root: str
    mano: str
    """MANO_RIGHT.pkl."""
    split: str = "train"
    version: str = "v3"

    def open(self) -> FrameSource:
        """List the frames of the split."""
        from poem_jax.data.sources.ho3d import HO3D

        return HO3D(self.root, split=self.split, version=self.version, mano=self.mano)


@dataclass(frozen=True)
class OakInkSource:
    """Raw OakInk, its images."""

    root: str
    mano: str | None = None
    """MANO_RIGHT.pkl; the set stores its vertices."""
    split: str = "train+val"
    """The paper's training set."""
    setup: str = "SP2"
    quarter: bool = False
    """Every fourth frame."""

    def open(self) -> FrameSource:
        """List the frames of the split."""
        from poem_jax.data.sources.oakink import OakInk

        return OakInk(self.root, split=self.split, setup=self.setup, quarter=self.quarter, mano=self.mano)


@dataclass(frozen=True)
class ArcticSource:
    """Raw ARCTIC."""

    root: str
    mano: str
    """MANO_RIGHT.pkl."""
    split: str = "train"
    setup: str = "p1"

    def open(self) -> FrameSource:
        """List the frames of the split."""
        from poem_jax.data.sources.arctic import Arctic

        return Arctic(self.root, split=self.split, setup=self.setup, mano=self.mano)


@dataclass(frozen=True)
class InterHandSource:
    """Raw InterHand2.6M."""

    root: str
    mano: str
    """MANO_RIGHT.pkl."""
    split: str = "train"
    views: int = 8
    """Cameras of a frame, drawn from its fifty and more."""
    seed: int = 0
    """Of that draw."""

    def open(self) -> FrameSource:
        """List the frames of the split."""
        from poem_jax.data.sources.interhand import InterHand

        return InterHand(self.root, split=self.split, views=self.views, seed=self.seed, mano=self.mano)


@dataclass(frozen=True)
class FreiHANDSource:
    """Raw FreiHAND: one view a frame."""

    root: str
    mano: str | None = None
    """MANO_RIGHT.pkl, for the mean pose; the set stores its vertices."""
    split: str = "train"
    backgrounds: int = 1
    """Of each training image: 1 = the paper's 32,560 images, 4 = all 130,240."""

    def open(self) -> FrameSource:
        """List the frames of the split."""
        from poem_jax.data.sources.freihand import FreiHAND

        return FreiHAND(self.root, split=self.split, backgrounds=self.backgrounds, mano=self.mano)


@dataclass(frozen=True)
class CapturesSource:
    """Your own captures with labels, such as `poem fit` writes."""

    folders: tuple[str, ...]
    labels: tuple[str, ...] | None = None
    """File of labels of each folder; None = the one that lies in it."""
    mano: str | None = None
    """MANO_RIGHT.pkl or MANO_LEFT.pkl, for labels with pose and shape but no vertices."""
    max_reprojection_px: float | None = None
    """Leave out views where a fit is farther than this from its key points, on average; None = keep them."""

    def open(self) -> FrameSource:
        """List the frames of the captures."""
        from poem_jax.data.sources.captures import Captures

        return Captures(
            self.folders, labels=self.labels, mano=self.mano, max_reprojection_px=self.max_reprojection_px
        )


@dataclass(frozen=True)
class SyntheticSource:
    """The captures of `data.synthetic`, drawn on the fly: of a sample's views the first are taken, as many as
    the part's `views` says. They have been augmented by their own config."""


FramesSource: TypeAlias = (
    ReleasedTarsSource
    | DexYCBSource
    | HO3DSource
    | OakInkSource
    | ArcticSource
    | InterHandSource
    | FreiHANDSource
    | CapturesSource
)
AnySource: TypeAlias = FramesSource | SyntheticSource


class ImageDecoder(enum.Enum):
    """What decodes images; see `data/pictures.py`."""

    OPENCV = "opencv"
    TURBO = "turbo"
    """libjpeg-turbo, by the extra `turbo`: refuses more damaged JPEGs, and can shrink while it decodes."""


@dataclass(frozen=True)
class Part:
    """One source and its share."""

    source: AnySource
    weight: float = 1.0
    """How often it is drawn, relative to the others."""
    views: ViewSampling = UniformViews()
    """How many of a frame's views a sample has, and in which order; at most the `num_views` of its batch."""
    held_out: float = 0.0
    """Share of the frames that is validated on and never trained on: the last ones of every capture or shard,
    or of the whole where the source does not tell such apart."""

    def __post_init__(self) -> None:
        if not 0 <= self.held_out < 1 or (self.held_out and isinstance(self.source, SyntheticSource)):
            raise ValueError(
                "`held_out` must lie in 0..1, 1 excluded, and be 0 for synthetic captures, which validation "
                f"draws anew; got {self}"
            )
        if not self.weight > 0:
            raise ValueError(f"`weight` must be positive (leave the part out instead); got {self}")


@dataclass(frozen=True)
class MixtureConfig:
    """Which data sets, in which shares, how they are augmented, and what is done about corrupt samples."""

    parts: tuple[Part, ...]
    recipe: Recipe = PAPER
    """Augmentation of all but synthetic captures."""
    decoder: ImageDecoder = ImageDecoder.OPENCV
    """Of their images. Pixels differ a little between the two."""
    pose: bool = False
    """Samples carry pose and shape, for parametric models; every source must have them then."""
    max_corrupt_share: float = 0.01
    """A run stops when more of its samples than this, of at least 100, could not be used."""
    processes: int = 2
    """Worker processes that read, decode and augment; 0 = the threads of `data.workers` do it."""

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError("`mixture.parts` must name at least one source; got none")
        if not 0 <= self.max_corrupt_share <= 1 or self.processes < 0:
            raise ValueError(
                "`mixture.max_corrupt_share` must lie in 0..1 and `mixture.processes` be at least 0; got "
                f"{self.max_corrupt_share} and {self.processes}"
            )
        if self.recipe.shrinks_while_decoding and self.decoder is ImageDecoder.OPENCV:
            raise ValueError(
                "`mixture.recipe.shrinks_while_decoding` needs a decoder that can: `mixture.decoder` TURBO; "
                "got OPENCV"
            )
        least = min(self.shares)
        if least < LEAST_SHARE:
            raise ValueError(
                f"every part's share of the weights must be at least {LEAST_SHARE}; the least is {least:.2g}"
            )

    @property
    def shares(self) -> tuple[float, ...]:
        """The parts' weights over their sum."""
        total = sum(part.weight for part in self.parts)
        return tuple(part.weight / total for part in self.parts)
