"""A system that is neither POEM nor a baseline, and small enough to see through: what runs all must run it.

It reads the mean colour of every view. Registered as the real ones are: one line in `systems.MODULES`.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.hand.model import HandModel, template_queries
from poem_jax.hand.topology import QueryOrder
from poem_jax.models import systems
from poem_jax.models.config import CropConfig, GridDraw, ModelConfig
from poem_jax.models.layers import NormMode, linear
from poem_jax.models.network import Constant, HandConstants
from poem_jax.models.world_frame import Reconstruction, WorkingFrame, leave_working_frame
from poem_jax.typing import Array, Float

GRID_POINTS, DRAWN_POINTS = 6, 4


@dataclass(frozen=True)
class StandInConfig(ModelConfig):
    """The choices in which systems differ for those who run them."""

    image_hw: tuple[int, int] = (32, 32)
    image_mean: float = 0.5
    image_std: float = 1.0
    crop: CropConfig = CropConfig()
    draws: bool = False
    ball_is_empty: bool = False
    coupled: bool = False
    views: int | None = None

    @property
    def query_order(self) -> QueryOrder:
        """As in the releases."""
        return QueryOrder.JOINTS_FIRST

    @property
    def grid_draw(self) -> GridDraw | None:
        """Some points of a tiny grid."""
        return GridDraw(DRAWN_POINTS, GRID_POINTS) if self.draws else None

    @property
    def view_range(self) -> tuple[int, int | None]:
        """One number, or any."""
        return (self.views or 1), self.views

    @property
    def couples_samples(self) -> bool:
        """Whether the brightest sample of a batch darkens the others."""
        return self.coupled


class Seen(NamedTuple):
    """The mean colour of each view."""

    colour: Float[Array, "*batch 3"]


class StandIn(nnx.Module):
    """The template half a metre before the primary camera, moved by the mean colour."""

    def __init__(self, config: StandInConfig, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.config, self.hand = config, HandConstants(hand)
        self.move = linear(3, 3, rngs=rngs)
        self.norm_mean = nnx.BatchStat(jnp.zeros(3))
        self.template = Constant(jnp.asarray(template_queries(hand, config.query_order)))

    def look(self, views: Array, mode: NormMode, settled: NormMode | None = None) -> Seen:
        """Average over the pixels, as sums of whole numbers: exact, in whatever order."""
        scale = 1.0 if views.dtype == jnp.uint8 else 255.0
        grey_levels = jnp.round(jnp.asarray(views, self.template[...].dtype) * scale)
        return Seen(jnp.mean(grey_levels, (-3, -2)) / 255)

    def find_hands(
        self,
        seen: Seen,
        frame: WorkingFrame,
        mode: NormMode,
        *,
        dropout_key: Any = None,
        ball_index: Array | None = None,
        key: Any = None,
    ) -> Prediction:
        """Average over the views and move the template."""
        mask = frame.cams.view_mask[..., None]
        colour = jnp.sum(jnp.where(mask, seen.colour, 0), 1) / jnp.maximum(jnp.sum(mask, 1), 1)
        if self.config.coupled:
            colour = colour / jnp.max(colour)
        moved = self.move(colour - self.norm_mean[...])
        if self.config.draws:
            count = mask.shape[1] * GRID_POINTS
            if ball_index is None:
                order = jax.random.permutation(key, count)[:DRAWN_POINTS]
                ball_index = jnp.broadcast_to(order, (len(colour), DRAWN_POINTS))
            moved = moved + 0.01 * jnp.mean(ball_index, -1, keepdims=True, dtype=moved.dtype)
        else:
            assert ball_index is key is None
        queries = self.template[...] + moved[:, None] + jnp.asarray([0, 0, 0.5], moved.dtype)
        valid = jnp.any(mask, (1, 2)) & (not self.config.ball_is_empty)
        layers = jnp.stack([queries, 0.9 * queries], 1)
        found = Reconstruction(None, None, None, None, valid, layers, None)
        return leave_working_frame(found, frame, self.hand.model(), self.config.query_order)


def register(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the stand-in a system for the length of a test."""
    monkeypatch.setitem(systems.MODULES, StandInConfig, "tests.stand_in:StandIn")
