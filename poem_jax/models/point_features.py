"""Image features of the basis points: a fixed cloud of points about the root (paper, "Point-Embedded
Intersection Sphere"), the maps that they sample, and codes that tell where a sample comes from.
"""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.sampling import sample_bilinear
from poem_jax.models.config import BasisConfig, BasisSampling, Config, Design
from poem_jax.models.layers import (
    Conv,
    ConvNorm,
    NormMode,
    TopDownBranch,
    TrunkRow,
    at_least_float32,
    double_bilinear,
)
from poem_jax.typing import Array, Bool, Float

_TEMPERATURE = 10000.0
_MIN_HEAT, _EVIDENCE_SCALE = 0.01, 0.25
"""Of an even map's heat, and what brings the logarithms to between -1.2 and, for 32 x 32 cells, 1.7."""
_EPSILON = 1e-6
"""Added by the release to the number of views, rows and columns that its positions are divided by."""


class FeatureBranch(nnx.Module):
    """Image features for the basis points, on a map of `config.features.stride`."""

    def __init__(self, config: Config, *, rngs: nnx.Rngs) -> None:
        trunk, features = config.backbone, config.features
        is_release = features.design is Design.RELEASE
        if is_release:
            self.branch = BottomUpBranch(trunk.channels, bias=True, rngs=rngs)
        else:
            self.branch = TopDownBranch(trunk.channels, trunk.strides, features.stride, rngs=rngs)
        self.num_joints = config.root.num_joints if features.heat_maps else 0
        self.project = Conv(self.branch.c_out + self.num_joints, config.width, 1, bias=True, rngs=rngs)
        self.position = ViewRowColumnCode(config.width, rngs=rngs) if is_release else None

    def __call__(
        self, levels: tuple[Array, ...], heat_maps: Float[Array, "image joint h2 w2"], mode: NormMode
    ) -> Float[Array, "image h w c"]:
        """Return the feature maps."""
        x = self.branch(levels, mode)
        return self.project(jnp.concatenate([x, evidence(heat_maps)], -1) if self.num_joints else x)

    def with_position(
        self, maps: Float[Array, "batch view h w c"], view_mask: Bool[Array, "batch view"]
    ) -> Float[Array, "batch view h w c"]:
        """Add the position code, if it belongs to the map."""
        return maps if self.position is None else maps + self.position(view_mask, maps.shape[2:4])


def evidence(heat_maps: Float[Array, "image joint h w"]) -> Float[Array, "image h w joint"]:
    """Return the logarithm of each map over an even one: zero where it says nothing."""
    cells = heat_maps.shape[-2] * heat_maps.shape[-1]
    return jnp.moveaxis(jnp.log(cells * heat_maps + _MIN_HEAT) * _EVIDENCE_SCALE, -3, -1)


class BottomUpBranch(TrunkRow):
    """From the finest map downwards: convolve with stride 2, add the next coarser map; at the end double the
    resolution once and halve the channels (the release's feature branch)."""

    def __init__(self, channels: tuple[int, ...], *, bias: bool = False, rngs: nnx.Rngs) -> None:
        self.reductions = nnx.List(
            ConvNorm(fine, coarse, 3, 2, bias=bias, rngs=rngs)
            for fine, coarse in itertools.pairwise(channels)
        )
        self.c_out = channels[-2]
        self.squeeze = Conv(channels[-1], self.c_out, 1, bias=True, rngs=rngs)

    def __call__(self, levels: tuple[Array, ...], mode: NormMode) -> Float[Array, "image h w c"]:
        """Return the map at the second coarsest stride."""
        x = levels[0]
        for reduce, coarser in zip(self.reductions, levels[1:], strict=True):
            x = self.run(reduce, x, mode) + coarser
        return self.squeeze(double_bilinear(x))


def basis_points(config: BasisConfig) -> Float[np.ndarray, "basis 3"]:
    """Draw the basis points, metres about the root; the same for the same config, always."""
    rng = np.random.Generator(np.random.PCG64(config.seed))
    inside = np.empty((0, 3))
    while len(inside) < config.num_points:
        drawn = _draw(rng, config)
        inside = np.concatenate([inside, drawn[np.linalg.norm(drawn, axis=-1) <= config.radius]])
    return inside[: config.num_points].astype(np.float32)


def _draw(rng: np.random.Generator, config: BasisConfig) -> Float[np.ndarray, "point 3"]:
    size = (config.num_points, 3)
    if config.sampling is BasisSampling.BALL:
        return rng.uniform(-config.radius, config.radius, size)
    return rng.normal(0.0, config.radius / 2, size)


def projected_features(
    feature_maps: Float[Array, "batch view h w c"],
    cams: Cameras,
    points_world: Float[Array, "batch basis 3"],
    image_hw: tuple[int, int],
    *,
    zeros_behind: bool = True,
) -> tuple[Float[Array, "batch view basis c"], Float[Array, "batch view basis 2"]]:
    """Sample every view's features where the points project (paper, eq. 5).

    Points that project outside the image sample zeros.

    Returns: the features, and the projections as shares (u / W, v / H) of the image; zero for points behind
    the camera, unless `zeros_behind` is False: these sample where they project through its centre.
    """
    uv_px, depth = project(cams.K, cams.T_cam_from_world, points_world[:, None])
    uv_share = uv_px / jnp.array(image_hw[::-1], uv_px.dtype)
    cells_wh = jnp.array(feature_maps.shape[-3:-1][::-1], uv_px.dtype)
    sampled = sample_bilinear(feature_maps, uv_share * cells_wh)
    if not zeros_behind:
        return sampled, uv_share
    seen = (depth > 0)[..., None]
    return jnp.where(seen, sampled, 0), jnp.where(seen, uv_share, 0)


def valid_views_first(
    maps: Float[Array, "batch view h w c"], cams: Cameras
) -> tuple[Float[Array, "batch view h w c"], Cameras]:
    """Bring the valid views of every sample to the front, in their order."""
    order = jnp.argsort(~cams.view_mask, axis=-1, stable=True)
    take = jax.vmap(lambda values, i: values[i])
    return take(maps, order), Cameras(*(take(leaf, order) for leaf in cams))


def sine_code(uv_share: Float[Array, "*batch 2"], width: int) -> Float[Array, "*batch c"]:
    """Encode positions (u / W, v / H) by sines (Carion et al. 2020, DETR).

    y comes before x; sine and cosine of a frequency are interleaved.
    """
    return interleaved_code(uv_share[..., ::-1], width // 2)


def interleaved_code(shares: Float[Array, "*batch axis"], width: int) -> Float[Array, "*batch c"]:
    """Encode every axis by `width` numbers: sine and cosine of 2 pi x / 10000^(2 i / width), interleaved."""
    frequency = 2 * np.pi * _TEMPERATURE ** (-2.0 * np.arange(width // 2) / width)
    angle = shares[..., None] * jnp.asarray(frequency, shares.dtype)
    code = jnp.stack([jnp.sin(angle), jnp.cos(angle)], -1)
    return code.reshape(*shares.shape[:-1], shares.shape[-1] * width)


class ViewRowColumnCode(nnx.Module):
    """A code of view number, row and column, c / 2 numbers each, mixed to the width of the map (release)."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.mix = Conv(3 * (width // 2), width, 1, bias=True, rngs=rngs)

    def __call__(
        self, view_mask: Bool[Array, "batch view"], map_hw: tuple[int, int]
    ) -> Float[Array, "batch view h w c"]:
        """Return what is added to each view's map; the mix is linear, so each axis is mixed alone."""
        assert self.mix.bias is not None
        kernel = self.mix.kernel[...][0, 0]
        to_view, to_row, to_column = jnp.split(at_least_float32(kernel), 3)
        views, rows, columns = place_codes(view_mask, map_hw, len(to_view), to_view.dtype)
        code = (
            (views @ to_view)[:, :, None, None]
            + (rows @ to_row)[:, None]
            + (columns @ to_column + self.mix.bias[...])
        )
        return code.astype(kernel.dtype)


def place_codes(
    view_mask: Bool[Array, "batch view"], map_hw: tuple[int, int], width: int, dtype: Any
) -> tuple[Float[Array, "batch view c"], Float[Array, "h c"], Float[Array, "w c"]]:
    """Encode number of the view, row and column, `width` sines and cosines each.

    Numbers count from 1 and are divided by how many there are, which for the views is the sample's valid
    ones: so the code depends on how many views there are, and masked views do not count. What stands at
    masked views means nothing.
    """
    number = jnp.cumsum(view_mask, -1).astype(dtype)
    count = jnp.sum(view_mask, -1, keepdims=True).astype(dtype)
    rows, columns = (
        axis_code(jnp.arange(1, size + 1, dtype=dtype), jnp.asarray(size, dtype), width) for size in map_hw
    )
    return axis_code(number, count, width), rows, columns


def axis_code(
    position: Float[Array, "*batch"], size: Float[Array, "*#batch"], width: int
) -> Float[Array, "*batch c"]:
    """Encode positions 1 .. size along one axis: sines, then cosines of p / 10000^(2 i / width)."""
    angle = position / (size + _EPSILON) * (2 * np.pi)
    period = _TEMPERATURE ** (2.0 * np.arange(width // 2) / width)
    angle = angle[..., None] / jnp.asarray(period, angle.dtype)
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)
