"""Three fixed rigs for the synthetic table: of eight, five and four cameras, each of its own geometry.

They stand as those of the paper's data sets do, roughly: around a table (DexYCB), in front of a person
(HO-3D), at the corners of a frame (OakInk). The world is z up, and the hands are about its origin. In each
rig the first two cameras look from 65 degrees apart or more, so that fewer of them still make a rig.
Fixed before any model was trained on them: change none of it.
"""

from dataclasses import dataclass, replace

from poem_jax.synthetic.config import StandingCamera, SyntheticConfig

TEST_FRAMES = 500
"""Of every rig."""
WORKING_VOLUME_M = (-0.12, 0.12)
"""Where the root joint is, along each axis."""


@dataclass(frozen=True)
class TableRig:
    """A rig and the seed of its test frames."""

    name: str
    cameras: tuple[StandingCamera, ...]
    test_seed: int


def _at(x: float, y: float, z: float, field_of_view_deg: float, roll_deg: float = 0.0) -> StandingCamera:
    return StandingCamera((x, y, z), roll_deg=roll_deg, field_of_view_deg=field_of_view_deg)


RING = TableRig(
    "ring",
    (
        _at(0.80, 0.00, 0.45, 50.0),
        _at(-0.05, 0.85, 0.35, 55.0),
        _at(-0.75, -0.30, 0.50, 50.0),
        _at(0.20, -0.80, 0.60, 50.0),
        _at(0.55, 0.60, 0.75, 45.0),
        _at(-0.60, 0.55, 0.25, 60.0),
        _at(-0.40, -0.70, 0.90, 45.0),
        _at(0.70, -0.45, 0.20, 60.0),
    ),
    test_seed=870_801,
)
"""Eight around a table, from 0.2 to 0.9 m above it."""
FRONT = TableRig(
    "front",
    (
        _at(0.55, -0.35, 0.10, 65.0, roll_deg=4.0),
        _at(0.15, 0.65, 0.40, 60.0, roll_deg=-3.0),
        _at(0.75, 0.20, 0.55, 55.0),
        _at(0.30, -0.70, 0.50, 60.0, roll_deg=6.0),
        _at(0.50, 0.45, -0.15, 65.0),
    ),
    test_seed=870_802,
)
"""Five in one half space, 0.65 to 0.95 m away: what looks away from all of them is seen by none."""
CORNERS = TableRig(
    "corners",
    (
        _at(0.60, 0.60, 0.70, 50.0),
        _at(-0.60, 0.60, 0.65, 50.0),
        _at(-0.60, -0.60, 0.70, 50.0, roll_deg=90.0),
        _at(0.60, -0.60, 0.75, 50.0, roll_deg=-90.0),
    ),
    test_seed=870_803,
)
"""Four at the upper corners of a frame, two of them lying on their sides."""
TABLE_RIGS = (RING, FRONT, CORNERS)


def captures_of(rig: TableRig, distribution: SyntheticConfig) -> SyntheticConfig:
    """Return a distribution of captures with the rig's cameras, hands about its middle."""
    return replace(
        distribution,
        num_views=len(rig.cameras),
        cameras=replace(distribution.cameras, rig=rig.cameras),
        body=replace(distribution.body, world_offset_m=WORKING_VOLUME_M),
    )
