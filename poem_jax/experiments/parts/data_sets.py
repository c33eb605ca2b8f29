"""Where the six data sets lie, and how often each is drawn: the one place that names their paths and shares.

Tars are the authors' packed ones, looked for in `data/dataset_tars/` below the folder that `poem train` is
started in, where the release has them; raw sets in `data/raw/`. Elsewhere: start where that folder is, link
it, or copy the experiment's file and name your own sources.
"""

from dataclasses import replace
from typing import NamedTuple

from poem_jax.data.augmentation_recipes import Recipe
from poem_jax.data.view_sampling import AllViews, ReleaseNormalViews, UniformViews
from poem_jax.mixture.config import (
    ArcticSource,
    CapturesSource,
    DexYCBSource,
    FramesSource,
    FreiHANDSource,
    HO3DSource,
    InterHandSource,
    MixtureConfig,
    OakInkSource,
    Part,
    ReleasedTarsSource,
    SyntheticSource,
)
from poem_jax.tables.places import Places

_PLACES = Places()
TARS, RAW, MANO = str(_PLACES.tars), str(_PLACES.raw), str(_PLACES.mano)
PROCESSES = 8


class DataSet(NamedTuple):
    """One of the paper's training sets."""

    shards: str
    """Pattern below `TARS`."""
    raw: FramesSource
    share: float
    """Of the paper's mixture."""
    most_views: int
    """Cameras that a frame is seen by."""
    frames: int
    """Multi-view frames, by the paper."""

    def source(self, *, raw: bool) -> FramesSource:
        """Return the raw set, or its tars."""
        return self.raw if raw else ReleasedTarsSource((f"{TARS}/{self.shards}",))


SETS = {
    "dexycb": DataSet(
        "DexYCB_mv/DexYCB_mv_train-{000000..000019}.tar",
        DexYCBSource(f"{RAW}/DexYCB", MANO),
        0.18,
        8,
        25_387,
    ),
    "ho3d": DataSet(
        "HO3D_mv/HO3D_mv_train-{000000..000008}.tar", HO3DSource(f"{RAW}/HO3D", MANO), 0.18, 5, 9_087
    ),
    "oakink": DataSet(
        "Oakink_mv/Oakink_mv_train+val-{000000..000103}.tar",
        OakInkSource(f"{RAW}/OakInk", MANO),
        0.18,
        4,
        58_692,
    ),
    "arctic": DataSet(
        "Arctic_mv/Arctic_mv_train_p1-{000000..000360}.tar",
        ArcticSource(f"{RAW}/arctic", MANO),
        0.18,
        8,
        135_271,
    ),
    "interhand": DataSet(
        "Interhand_mv/Interhand_mv_train-{000000..000075}.tar",
        InterHandSource(f"{RAW}/InterHand2.6M", MANO),
        0.18,
        8,
        210_006,
    ),
    "freihand": DataSet(
        "Freihand_mv/Freihand_mv_train-{000000..000004}.tar",
        FreiHANDSource(f"{RAW}/FreiHAND", MANO),
        0.10,
        1,
        32_560,
    ),
}


def six_sets(recipe: Recipe, *, raw: bool = False, by_release: bool = False) -> MixtureConfig:
    """Return the paper's mixture of all six.

    Args:
        recipe: of augmentation.
        raw: read raw data sets instead of tars; only they have the pose of every hand.
        by_release: draw views as the release does, N(4, 2), and not each number as often.
    """
    parts = [
        Part(
            of.source(raw=raw),
            of.share,
            ReleaseNormalViews(1, of.most_views) if by_release else UniformViews(1, of.most_views),
        )
        for of in SETS.values()
    ]
    return MixtureConfig(tuple(parts), recipe=recipe, pose=raw, processes=PROCESSES)


def one_set(name: str, recipe: Recipe) -> MixtureConfig:
    """Return one set alone with all its cameras in their own order, as POEM v1 is trained."""
    return MixtureConfig(
        (Part(SETS[name].source(raw=False), 1.0, AllViews()),), recipe=recipe, processes=PROCESSES
    )


def on_captures(folder: str, recipe: Recipe, *, box_ratio: float) -> MixtureConfig:
    """Return the user's own captures, whose last fifth is held out, and one sample in four synthetic.

    Args:
        folder: a capture; `--data` names others.
        recipe: of augmentation.
        box_ratio: the model's `crop.ratio`.
    """
    own = Part(CapturesSource((folder,)), 0.75, UniformViews(2), held_out=0.2)
    synthetic = Part(SyntheticSource(), 0.25, UniformViews(2))
    return MixtureConfig((own, synthetic), recipe=replace(recipe, box_ratio=box_ratio), processes=1)
