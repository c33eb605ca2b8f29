"""Configuration of the cameras' frustum grids and of the space that positions are normalised in; shared by
POEM v1 and the baselines."""

import enum
import math
from dataclasses import dataclass

from poem_jax.models.config import require, require_counts


class DepthSteps(enum.StrEnum):
    """How the depths of a frustum grid follow each other; the end itself is never reached."""

    LINEAR = "linear"
    """start + (end - start) i / D."""
    LINEAR_INCREASING = "linear_increasing"
    """start + (end - start) i (i + 1) / (D (D + 1)): dense near the camera."""


@dataclass(frozen=True)
class Cuboid:
    """A box in the primary camera's frame, metres, in which positions are normalised to [0, 1]."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        ends = (self.low, self.high)
        require(
            all(isinstance(end, tuple) and len(end) == 3 for end in ends),
            f"`low` and `high` must be (x, y, z); got {self.low} and {self.high}",
        )
        require(
            all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(*ends, strict=True)),
            f"`low` must lie below `high` along every axis, both finite; got {self.low} and {self.high}",
        )


DEXYCB_CUBOID = Cuboid((-1.2, -1.2, 0.2), (1.2, 1.2, 2.0))
"""Also the paper's, in its ablation of one stage."""
CUBOIDS = {
    "dexycb": DEXYCB_CUBOID,
    "ho3d": Cuboid((-0.6, -0.6, 0.0), (0.6, 0.6, 1.2)),
    "oakink": Cuboid((-1.0, -1.0, 0.0), (1.0, 1.0, 1.5)),
}
"""Where hands are in the data sets that POEM v1 and its baselines were released for."""


@dataclass(frozen=True)
class FrustumConfig:
    """A grid of points along the rays of every cell of a feature map."""

    num_depths: int = 32
    start: float = 0.2
    """Metres before the camera."""
    end: float = 2.0
    steps: DepthSteps = DepthSteps.LINEAR_INCREASING
    cell_offset: float = 0.5
    """Cell i stands for pixel `stride` x (i + `cell_offset`): 0.5 is its centre; the release has 0."""

    def __post_init__(self) -> None:
        require_counts(self, "num_depths")
        require(
            0 <= self.start < self.end < math.inf,
            f"`start` must be at least 0 and below `end`; got {self.start} and {self.end}",
        )
        require(0 <= self.cell_offset < 1, f"`cell_offset` must be in [0, 1); got {self.cell_offset}")
