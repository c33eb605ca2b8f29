"""Branches that join the scales of a trunk."""

import itertools

import jax.numpy as jnp
from flax import nnx

from poem_jax.models.batch_norm import NormMode
from poem_jax.models.convolution import Conv, ConvNorm
from poem_jax.models.resampling import double_bilinear
from poem_jax.typing import Array, Float


class TopDownBranch(nnx.Module):
    """From the coarsest map upwards: double the resolution, concatenate the next finer map, convolve.

    The design of the heat-map branch (paper, section "Heatmap-based Root Estimation") and, in the paper, of
    the feature branch too; it stops at `stride`.
    """

    def __init__(
        self,
        channels: tuple[int, ...],
        strides: tuple[int, ...],
        stride: int,
        *,
        bias: bool = False,
        rngs: nnx.Rngs,
    ) -> None:
        self.finest = strides.index(stride)
        merged = range(len(channels) - 1, self.finest, -1)
        self.merges = nnx.List(
            ConvNorm(channels[coarse] + channels[coarse - 1], channels[coarse - 1], 3, bias=bias, rngs=rngs)
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


class BottomUpBranch(nnx.Module):
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
            x = reduce(x, mode) + coarser
        return self.squeeze(double_bilinear(x))
