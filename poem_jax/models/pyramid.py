"""Top-down decoder that joins the scales of a trunk: the shared design of heat-map and feature branch."""

import jax.numpy as jnp
from flax import nnx

from poem_jax.models.batch_norm import NormMode
from poem_jax.models.convolution import ConvNorm
from poem_jax.models.upsampling import double_bilinear
from poem_jax.typing import Array, Float


class TopDownBranch(nnx.Module):
    """From the coarsest map upwards: double the resolution, concatenate the next finer map, convolve.

    Paper, section "Heatmap-based Root Estimation"; it stops at `stride`.
    """

    def __init__(
        self, channels: tuple[int, ...], strides: tuple[int, ...], stride: int, *, rngs: nnx.Rngs
    ) -> None:
        self.finest = strides.index(stride)
        merged = range(len(channels) - 1, self.finest, -1)
        self.merges = nnx.List(
            ConvNorm(channels[coarse] + channels[coarse - 1], channels[coarse - 1], 3, rngs=rngs)
            for coarse in merged
        )
        self.c_out = channels[self.finest]

    def __call__(self, levels: tuple[Array, ...], mode: NormMode) -> Float[Array, "image h w c"]:
        """Return the map at `stride`, with the width of the trunk's map there."""
        coarse_to_fine = levels[self.finest :][::-1]
        x = coarse_to_fine[0]
        for merge, finer in zip(self.merges, coarse_to_fine[1:], strict=True):
            x = merge(jnp.concatenate([double_bilinear(x), finer], -1), mode)
        return x
