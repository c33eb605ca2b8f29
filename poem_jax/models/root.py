"""First stage: joints in the images from heat maps (paper, section "Root Point from Triangulation")."""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.geometry.sampling import soft_argmax
from poem_jax.models.batch_norm import NormMode
from poem_jax.models.config import HeatActivation, HRNetConfig, ResNetConfig, RootConfig
from poem_jax.models.convolution import Conv
from poem_jax.models.pyramid import TopDownBranch
from poem_jax.models.resampling import max_pool
from poem_jax.typing import Array, Float


class HeatMapBranch(nnx.Module):
    """Heat maps of the joints and their expectation in pixels."""

    def __init__(
        self, config: RootConfig, trunk: HRNetConfig | ResNetConfig, *, bias: bool = False, rngs: nnx.Rngs
    ) -> None:
        self.stride, self.cell_offset = config.stride, config.cell_offset
        self.pooling, self.sum_epsilon = config.pooling, config.sum_epsilon
        self.branch = TopDownBranch(trunk.channels, trunk.strides, config.branch_stride, bias=bias, rngs=rngs)
        self.to_logits = Conv(self.branch.c_out, config.num_joints, 1, bias=True, rngs=rngs)
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


def spread(heat_maps: Float[Array, "*batch h w"]) -> Float[Array, "*batch"]:
    """Return the variance of maps that sum to 1, cells squared, summed over both axes."""
    h, w = heat_maps.shape[-2:]
    along_u, along_v = jnp.sum(heat_maps, -2), jnp.sum(heat_maps, -1)
    return _variance(along_u, w) + _variance(along_v, h)


def _variance(profile: Float[Array, "*batch cell"], size: int) -> Float[Array, "*batch"]:
    cells = jnp.arange(size, dtype=profile.dtype)
    mean = jnp.sum(profile * cells, -1, keepdims=True)
    return jnp.sum(profile * (cells - mean) ** 2, -1)
