"""Basis points drawn from the cameras' frustum grids: those in a ball, in random order (paper, "Basis Points
Acquisition"; the ball query of Qi et al. 2017, PointNet++).

The release permutes all grid points and keeps the first in the ball. Here every grid point has a random
number, drawn for the valid views in their order, and those in the ball with the largest numbers are kept,
largest first: the same, and masked views change nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from poem_jax.models.poem_v1_config import BallConfig
from poem_jax.typing import Array, Bool, Float, Int, PRNGKeyArray


class Ball(NamedTuple):
    """What was drawn."""

    index: Int[Array, "batch basis"]
    """Numbers in the grid (view, w, h, depth), flattened; -1 = none left in the ball."""
    count: Int[Array, " batch"]
    """How many grid points the ball holds, drawn or not."""


def draw_ball(
    config: BallConfig,
    grid: Float[Array, "batch view w h depth 3"],
    centre: Float[Array, "batch 3"],
    view_mask: Bool[Array, "batch view"],
    key: PRNGKeyArray,
) -> Ball:
    """Draw `num_points` grid points of valid views in the ball, without repetition.

    Args:
        config: number of points and radius.
        grid: points in metres.
        centre: of the ball, in the same frame.
        view_mask: views whose points count.
        key: the only randomness; the order is the same for all samples of a batch.
    """
    batch, view = view_mask.shape
    points = grid.reshape(batch, view, -1, 3)
    inside = in_ball(config, points, centre) & view_mask[..., None]
    # Half the numbers of float32 in [0, 1) are enough for grids of a million points; ties keep their order.
    drawn = jax.vmap(lambda i: jax.random.uniform(jax.random.fold_in(key, i), points.shape[2:3]))(
        jnp.arange(view)
    )
    rank = jnp.maximum(jnp.cumsum(view_mask, -1) - 1, 0)
    score = jnp.where(inside, drawn[rank], -1.0).reshape(batch, -1)
    best, index = jax.lax.top_k(score, config.num_points)
    return Ball(jnp.where(best < 0, -1, index), jnp.sum(inside, (1, 2)))


def in_ball(
    config: BallConfig, points: Float[Array, "batch view point 3"], centre: Float[Array, "batch 3"]
) -> Bool[Array, "batch view point"]:
    """Tell which points are nearer to the centre than the radius."""
    square = sum((points[..., i] - centre[:, None, None, i]) ** 2 for i in range(3))
    return square < config.radius**2


def filled(index: Int[Array, "batch basis"]) -> Int[Array, "batch basis"]:
    """Put the first point that the ball holds in the place of every -1, as PointNet++ does; grid point 0 if
    it holds nothing. Who searches for neighbours leaves these copies out."""
    first = jnp.take_along_axis(index, jnp.argmax(index >= 0, -1, keepdims=True), -1)
    return jnp.maximum(jnp.where(index >= 0, index, first), 0)


def points_at(
    grid: Float[Array, "batch view w h depth 3"], index: Int[Array, "batch basis"]
) -> Float[Array, "batch basis 3"]:
    """Return the grid points of these numbers; the primary camera's centre for -1, as the release has it."""
    points = grid.reshape(len(grid), -1, 3)
    taken = jax.vmap(lambda rows, i: rows[i])(points, jnp.maximum(index, 0))
    return jnp.where((index >= 0)[..., None], taken, 0)
