"""The cameras' frustum grids and the codes of position that POEM v1 and the baselines add to image features.

A frustum grid holds points along the ray of every cell of a feature map, at given depths, moved to the
primary camera's frame (paper, section "Main experiments", i) Position Embedded Fusion; Liu et al. 2022,
PETR). Its tensor order is the paper's and the release's: (view, W, H, D).
"""

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.geometry.cameras import Cameras, unproject
from poem_jax.models.frustum_config import Cuboid, DepthSteps, FrustumConfig
from poem_jax.models.point_features import interleaved_code, place_codes
from poem_jax.typing import Array, Bool, Float

_EPSILON = 1e-5
"""Shares closer than this to 0 or 1 are counted as this close by `inverse_sigmoid`."""
_Y_X_Z = np.array([1, 0, 2], np.int32)


def frustum_depths(config: FrustumConfig) -> Float[np.ndarray, " depth"]:
    """Return the depths of a grid, metres along the optical axis, nearest first."""
    i, count = np.arange(config.num_depths), config.num_depths
    linear = config.steps is DepthSteps.LINEAR
    share = i / count if linear else i * (i + 1) / (count * (count + 1))
    return (config.start + (config.end - config.start) * share).astype(np.float32)


def frustum_grid(
    config: FrustumConfig, cams: Cameras, map_hw: tuple[int, int], image_hw: tuple[int, int]
) -> Float[Array, "batch view w h depth 3"]:
    """Return the points of every camera's grid in the world of `cams`, metres.

    Args:
        config: depths, and which pixel a cell stands for.
        cams: cameras; masked views must hold finite numbers (`fill_masked_views`), and their points mean
            nothing.
        map_hw: cells of the feature map.
        image_hw: pixels of the image that `cams.K` belongs to.
    """
    (h, w), depth = map_hw, jnp.asarray(frustum_depths(config), cams.K.dtype)
    u, v = (
        (jnp.arange(cells, dtype=cams.K.dtype) + config.cell_offset) * (pixels / cells)
        for cells, pixels in ((w, image_hw[1]), (h, image_hw[0]))
    )
    grid = (w, h, config.num_depths)
    uv_px = jnp.stack([jnp.broadcast_to(u[:, None, None], grid), jnp.broadcast_to(v[:, None], grid)], -1)
    points = unproject(
        cams.K, cams.T_cam_from_world, uv_px.reshape(-1, 2), jnp.broadcast_to(depth, grid).reshape(-1)
    )
    return points.reshape(*cams.K.shape[:2], *grid, 3)


def frustum_channels(
    grid: Float[Array, "batch view w h depth 3"], cuboid: Cuboid
) -> Float[Array, "batch view h w c"]:
    """Return the grid as a map: channel 3 d + (x, y or z) is the logit of the normalised coordinate.

    This is what the release's position encoders read.
    """
    logits = inverse_sigmoid(normalised(grid, cuboid))
    batch, view, w, h, depth, _ = logits.shape
    return jnp.swapaxes(logits.reshape(batch, view, w, h, 3 * depth), 2, 3)


def normalised(points: Float[Array, "*batch 3"], cuboid: Cuboid) -> Float[Array, "*batch 3"]:
    """Return positions in metres as shares of the cuboid, [0, 1] inside it; not clipped."""
    low, size = _low_and_size(cuboid, points)
    return (points - low) / size


def denormalised(shares: Float[Array, "*batch 3"], cuboid: Cuboid) -> Float[Array, "*batch 3"]:
    """Undo `normalised`: return metres."""
    low, size = _low_and_size(cuboid, shares)
    return shares * size + low


def _low_and_size(cuboid: Cuboid, like: Array) -> tuple[Array, Array]:
    low, high = (np.array(end, np.float64) for end in (cuboid.low, cuboid.high))
    return jnp.asarray(low, like.dtype), jnp.asarray(high - low, like.dtype)


def inverse_sigmoid(shares: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return log(x / (1 - x)) of x clipped to [0, 1], numerator and denominator to at least 1e-5."""
    x = jnp.clip(shares, 0, 1)
    return jnp.log(jnp.maximum(x, _EPSILON) / jnp.maximum(1 - x, _EPSILON))


def view_row_column_code(
    view_mask: Bool[Array, "batch view"], map_hw: tuple[int, int], width: int
) -> Float[Array, "batch view h w c"]:
    """Return the codes of view, row and column (`place_codes`) side by side, `width` numbers each."""
    views, rows, columns = place_codes(view_mask, map_hw, width, jnp.result_type(float))
    shape = (*view_mask.shape, *map_hw, width)
    parts = (views[:, :, None, None], rows[:, None], columns)
    return jnp.concatenate([jnp.broadcast_to(part, shape) for part in parts], -1)


def point_sine_code(points: Float[Array, "*batch 3"], width: int) -> Float[Array, "*batch c"]:
    """Encode points, given as shares of their space, by `width` numbers an axis, in the order y, x, z.

    Sine and cosine of a frequency, 2 pi / 10000^(2 i / width), are interleaved (PETR's `pos2posemb3d`).
    """
    return interleaved_code(points[..., _Y_X_Z], width)


def sigmoid_step(shares: Float[Array, "*shape"], offset: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Move normalised coordinates: sigmoid(offset + inverse_sigmoid(shares)) (Zhu et al. 2021)."""
    return jax.nn.sigmoid(offset + inverse_sigmoid(shares))
