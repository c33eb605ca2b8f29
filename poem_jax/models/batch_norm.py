"""Batch normalisation over the views that exist.

Padded views hold no image, so moments are taken over valid views only; with `axis_name` over those of all
devices of a `pmap` or `shard_map`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.typing import Array, Bool, Float

EPSILON = 1e-5
MOMENTUM = 0.1
"""Share of the new batch in the running statistics (torch's convention)."""


class NormMode(NamedTuple):
    """Which moments normalise: the running ones, or those of the valid images at hand."""

    image_mask: Bool[Array, " image"] | None = None
    """None = running statistics (inference); else True = an image that counts (training)."""
    axis_name: str | None = None
    """Device axis to average over."""

    @property
    def training(self) -> bool:
        """Whether the moments of the images at hand are used."""
        return self.image_mask is not None


class MaskedBatchNorm(nnx.Module):
    """Per-channel batch norm of NHWC maps (Ioffe and Szegedy 2015) with masked, one-pass moments."""

    def __init__(self, channels: int, *, scale_init: float = 1.0) -> None:
        self.scale = nnx.Param(jnp.full((channels,), scale_init))
        self.bias = nnx.Param(jnp.zeros((channels,)))
        self.mean = nnx.BatchStat(jnp.zeros((channels,)))
        self.variance = nnx.BatchStat(jnp.ones((channels,)))

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h w c"]:
        """Normalise; in training also move the running statistics."""
        mean, variance = (self.mean[...], self.variance[...])
        if mode.image_mask is not None:
            mean, variance, count = masked_moments(x, mode.image_mask, mode.axis_name)
            self._move_towards(mean, variance, count)
        gain = self.scale[...] * jax.lax.rsqrt(variance + EPSILON)
        return x * gain + (self.bias[...] - mean * gain)

    def _move_towards(self, mean: Array, variance: Array, count: Array) -> None:
        share = jnp.where(count > 0, MOMENTUM, 0.0)
        unbiased = variance * count / jnp.maximum(count - 1.0, 1.0)
        self.mean[...] += jax.lax.stop_gradient(share * (mean - self.mean[...]))
        self.variance[...] += jax.lax.stop_gradient(share * (unbiased - self.variance[...]))


def masked_moments(
    x: Float[Array, "image h w c"], image_mask: Bool[Array, " image"], axis_name: str | None = None
) -> tuple[Float[Array, " c"], Float[Array, " c"], Float[Array, ""]]:
    """Return mean, biased variance and number of pixels over the valid images; without any: 0, 0, 0."""
    weight = image_mask.astype(x.dtype)
    kept = x * weight[:, None, None, None]
    sums = (jnp.sum(kept, (0, 1, 2)), jnp.sum(kept * x, (0, 1, 2)), jnp.sum(weight) * x.shape[1] * x.shape[2])
    if axis_name is not None:
        sums = jax.lax.psum(sums, axis_name)
    total, total_squared, count = sums
    mean = total / jnp.maximum(count, 1.0)
    variance = jnp.maximum(total_squared / jnp.maximum(count, 1.0) - mean**2, 0.0)
    return mean, variance, count
