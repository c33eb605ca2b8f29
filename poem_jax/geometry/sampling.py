"""Reading feature maps and heat maps at real-valued positions.

Cells: a map (h, w) spans [0, w] x [0, h] in its own cells; the centre of cell (i, j) is (u, v) = (j + 0.5, i
+ 0.5). A pixel position divided by the map's stride is a cell position.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from poem_jax.typing import Array, Float


def sample_bilinear(
    feature_map: Float[Array, "*batch h w c"], uv_cells: Float[Array, "*batch point 2"]
) -> Float[Array, "*batch point c"]:
    """Read a map between its cell centres; outside the map there are zeros.

    Differentiable in the map and in the positions. More than a cell away from the map the value and the
    gradient are zero, however far away (also at infinity).
    """
    h, w, c = feature_map.shape[-3:]
    u, v = uv_cells[..., 0] - 0.5, uv_cells[..., 1] - 0.5
    # Clipped before the cast to integers, which is undefined for huge values; at -1 and w all weights are
    # zero.
    u, v = jnp.clip(u, -1, w), jnp.clip(v, -1, h)
    batch = feature_map.shape[:-3]
    cells = feature_map.reshape(-1, h * w, c)
    columns, rows = _corners(u.reshape(len(cells), -1), w), _corners(v.reshape(len(cells), -1), h)
    total = sum(
        _gather_rows(cells, row * w + column) * (row_weight * column_weight)[..., None].astype(cells.dtype)
        for row, row_weight in rows
        for column, column_weight in columns
    )
    return jnp.reshape(total, (*batch, uv_cells.shape[-2], c))


def sample_levels(
    levels: Sequence[Float[Array, "..."]], uv_share: Float[Array, "*batch level point 2"]
) -> Float[Array, "*batch level point c"]:
    """Read several maps of one scene, as `sample_bilinear` does, in one pass.

    One gather for all maps and corners: a gradient of many small ones takes long to compile.

    Args:
        levels: maps (*batch, h, w, c), each of its own resolution.
        uv_share: shares (u / W, v / H) of the maps; the first of the level axis belong to the first map.
    """
    c, batch, start = levels[0].shape[-1], uv_share.shape[:-3], 0
    count = math.prod(batch)
    cells, indices, weights = [], [], []
    for x, uv in zip(levels, jnp.moveaxis(uv_share, -3, 0), strict=True):
        h, w = x.shape[-3:-1]
        # As in `sample_bilinear`.
        u, v = jnp.clip(uv[..., 0] * w - 0.5, -1, w), jnp.clip(uv[..., 1] * h - 0.5, -1, h)
        columns, rows = _corners(u.reshape(count, -1), w), _corners(v.reshape(count, -1), h)
        corners = [(row, column) for row in rows for column in columns]
        indices += [start + row[0] * w + column[0] for row, column in corners]
        weights += [row[1] * column[1] for row, column in corners]
        cells.append(x.reshape(count, h * w, c))
        start += h * w
    points = uv_share.shape[-2]
    read = _gather_rows(jnp.concatenate(cells, 1), jnp.concatenate(indices, -1))
    read = read.reshape(count, len(levels), -1, points, c)
    shares = jnp.stack(weights, 1).reshape(count, len(levels), -1, points, 1).astype(read.dtype)
    return jnp.reshape(jnp.sum(read * shares, 2), (*batch, len(levels), points, c))


def soft_argmax(heatmap: Float[Array, "*batch h w"]) -> Float[Array, "*batch 2"]:
    """Return the centre of mass (u, v) of non-negative heat maps, in cells; an empty map gives its middle."""
    h, w = heatmap.shape[-2:]
    total = jnp.sum(heatmap, axis=(-2, -1))
    empty = total <= 0
    total = jnp.where(empty, 1, total)
    u = jnp.sum(jnp.sum(heatmap, axis=-2) * _centres(w, heatmap), axis=-1) / total
    v = jnp.sum(jnp.sum(heatmap, axis=-1) * _centres(h, heatmap), axis=-1) / total
    return jnp.stack([jnp.where(empty, w / 2, u), jnp.where(empty, h / 2, v)], axis=-1)


def _corners(x: Array, size: int) -> list[tuple[Array, Array]]:
    """Return the two neighbouring indices of `x` (in [-1, size]), clipped, and their weights, zero
    outside."""
    low = jax.lax.stop_gradient(jnp.floor(x))
    fraction = x - low
    index = low.astype(jnp.int32)
    corners = []
    for i, weight in ((index, 1 - fraction), (index + 1, fraction)):
        corners.append((jnp.clip(i, 0, size - 1), jnp.where((i >= 0) & (i < size), weight, 0)))
    return corners


def _gather_rows(cells: Float[Array, "b cell c"], index: Array) -> Float[Array, "b point c"]:
    """Take rows by indices (b, point) that are known to be in range."""
    return jax.vmap(lambda rows, i: rows.at[i].get(mode="promise_in_bounds"))(cells, index)


def _centres(size: int, like: Array) -> Array:
    return jnp.arange(size, dtype=like.dtype) + 0.5
