"""First stage: joints in the images from heat maps, their triangulation, and the root point (paper, section
"Root Point from Triangulation")."""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.sampling import soft_argmax
from poem_jax.geometry.triangulation import triangulate
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT
from poem_jax.models.config import Design, HeatActivation, HRNetConfig, ResNetConfig, RootConfig, ViewWeights
from poem_jax.models.layers import Conv, NormMode, TopDownBranch, max_pool
from poem_jax.typing import Array, Bool, Float

_FALLBACK_ROOT = (0.0, 0.0, 0.5)
"""Where the second stage works for samples without a root: in front of the primary camera, all finite."""
_MIN_VARIANCE = 0.25
"""Cells squared. Narrower heat maps weigh no more than this in the triangulation."""


class HeatMapBranch(nnx.Module):
    """Heat maps of the joints and their expectation in pixels."""

    def __init__(self, config: RootConfig, trunk: HRNetConfig | ResNetConfig, *, rngs: nnx.Rngs) -> None:
        bias = config.design is Design.RELEASE
        self.stride, self.cell_offset = config.stride, config.cell_offset
        self.pooling, self.sum_epsilon = config.pooling, config.sum_epsilon
        self.branch = TopDownBranch(trunk.channels, trunk.strides, config.branch_stride, bias=bias, rngs=rngs)
        self.to_logits = Conv(self.branch.c_out, config.num_joints, 1, bias=True, exact=True, rngs=rngs)
        self.activation = config.activation

    def __call__(
        self, levels: tuple[Array, ...], mode: NormMode
    ) -> tuple[Float[Array, "image joint 2"], Float[Array, "image joint h w"]]:
        """Return joint positions in pixels, the expectation (paper, eq. 3) of the heat maps, and the maps."""
        logits = jnp.moveaxis(self.to_logits(max_pool(self.branch(levels, mode), self.pooling)), -1, -3)
        if self.activation is HeatActivation.SOFTMAX:
            heat = jax.nn.softmax(logits, axis=(-2, -1))
        else:
            # Of logarithms, so that a map of very low logits is not 0 / 0.
            heat = jax.nn.softmax(jax.nn.log_sigmoid(logits), axis=(-2, -1))
        # `soft_argmax` takes a cell's centre for its position.
        keypoints = self.stride * (soft_argmax(heat) + (self.cell_offset - 0.5))
        if self.sum_epsilon:
            total = jnp.sum(jax.nn.sigmoid(logits), (-2, -1))[..., None]
            keypoints = keypoints * (total / (total + self.sum_epsilon))
        return keypoints, heat


def triangulate_joints(
    config: RootConfig,
    keypoints_px: Float[Array, "batch view joint 2"],
    heat_maps: Float[Array, "batch view joint h w"],
    cams: Cameras,
) -> tuple[Float[Array, "batch joint 3"], Bool[Array, "batch joint"]]:
    """Lift the joints to 3D in the world of `cams`.

    Returns: the joints, zero where they cannot be, and whether they can: two views determine a joint, and it
    lies before every camera that sees it.
    """
    weights = None
    if config.view_weights is ViewWeights.HEAT_SPREAD:
        weights = 1 / jnp.maximum(heat_variance(heat_maps), _MIN_VARIANCE)
    mask = jnp.broadcast_to(cams.view_mask[..., None], keypoints_px.shape[:-1])
    joints, solved = triangulate(
        keypoints_px,
        cams.K,
        cams.T_cam_from_world,
        weights,
        mask,
        normalise_rows=config.design is Design.PAPER,
    )
    _, depth = project(cams.K, cams.T_cam_from_world, joints[:, None])
    return joints, solved & jnp.all((depth > 0) | ~mask, 1)


def root_point(
    joints: Float[Array, "batch joint 3"],
    solved: Bool[Array, "batch joint"],
    known_root: Float[Array, "batch 3"],
    view_mask: Bool[Array, "batch view"],
) -> tuple[Float[Array, "batch 3"], Bool[Array, " batch"]]:
    """Return the point about which the second stage works, and whether there is one.

    It is `known_root`, or where that is NaN the triangulated root joint, or a point before the camera.
    """
    index = ROOT_JOINT if joints.shape[1] == NUM_JOINTS else 0
    known = jnp.all(jnp.isfinite(known_root), -1)
    root = jnp.where(known[:, None], known_root, joints[:, index])
    valid = (known | solved[:, index]) & jnp.any(view_mask, -1)
    return jnp.where(valid[:, None], root, jnp.array(_FALLBACK_ROOT, root.dtype)), valid


def heat_variance(heat_maps: Float[Array, "*batch h w"]) -> Float[Array, "*batch"]:
    """Return the variance of maps that sum to 1, cells squared, summed over both axes."""
    h, w = heat_maps.shape[-2:]
    along_u, along_v = jnp.sum(heat_maps, -2), jnp.sum(heat_maps, -1)
    return _variance(along_u, w) + _variance(along_v, h)


def _variance(profile: Float[Array, "*batch cell"], size: int) -> Float[Array, "*batch"]:
    cells = jnp.arange(size, dtype=profile.dtype)
    mean = jnp.sum(profile * cells, -1, keepdims=True)
    return jnp.sum(profile * (cells - mean) ** 2, -1)
