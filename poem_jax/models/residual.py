"""Residual blocks (He et al. 2016), shared by ResNet and HRNet."""

import jax
from flax import nnx

from poem_jax.models.batch_norm import NormMode
from poem_jax.models.convolution import ConvNorm
from poem_jax.typing import Array, Float

BOTTLENECK_EXPANSION = 4


class BasicBlock(nnx.Module):
    """Two 3 x 3 convolutions around a shortcut."""

    def __init__(self, c_in: int, c_out: int, stride: int = 1, *, rngs: nnx.Rngs) -> None:
        self.first = ConvNorm(c_in, c_out, 3, stride, rngs=rngs)
        self.second = ConvNorm(c_out, c_out, 3, relu=False, rngs=rngs)
        self.shortcut = _projection(c_in, c_out, stride, rngs)

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Apply the block."""
        y = self.second(self.first(x, mode), mode)
        return jax.nn.relu(y + (x if self.shortcut is None else self.shortcut(x, mode)))


class Bottleneck(nnx.Module):
    """1 x 1, 3 x 3 and 1 x 1 convolutions around a shortcut; the stride is in the 3 x 3."""

    def __init__(self, c_in: int, c_out: int, stride: int = 1, *, rngs: nnx.Rngs) -> None:
        inner = c_out // BOTTLENECK_EXPANSION
        self.reduce = ConvNorm(c_in, inner, 1, rngs=rngs)
        self.middle = ConvNorm(inner, inner, 3, stride, rngs=rngs)
        self.expand = ConvNorm(inner, c_out, 1, relu=False, rngs=rngs)
        self.shortcut = _projection(c_in, c_out, stride, rngs)

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Apply the block."""
        y = self.expand(self.middle(self.reduce(x, mode), mode), mode)
        return jax.nn.relu(y + (x if self.shortcut is None else self.shortcut(x, mode)))


def _projection(c_in: int, c_out: int, stride: int, rngs: nnx.Rngs) -> ConvNorm | None:
    if stride == 1 and c_in == c_out:
        return None
    return ConvNorm(c_in, c_out, 1, stride, relu=False, rngs=rngs)
