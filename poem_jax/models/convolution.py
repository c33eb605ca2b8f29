"""Convolutions of NHWC maps, alone and followed by batch norm."""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.batch_norm import MaskedBatchNorm, NormMode
from poem_jax.typing import Array, Float

_he_normal = jax.nn.initializers.variance_scaling(2.0, "fan_in", "normal")


class Conv(nnx.Module):
    """Square convolution with padding (size - 1) / 2; size 1 is a matrix product, far faster on a CPU."""

    def __init__(
        self, c_in: int, c_out: int, size: int, stride: int = 1, *, bias: bool = False, rngs: nnx.Rngs
    ) -> None:
        self.stride, self.size = stride, size
        self.kernel = nnx.Param(_he_normal(rngs.params(), (size, size, c_in, c_out)))
        self.bias = nnx.Param(jnp.zeros((c_out,))) if bias else None

    def __call__(self, x: Float[Array, "image h w c"]) -> Float[Array, "image h2 w2 c2"]:
        """Convolve."""
        y = self._pointwise(x) if self.size == 1 else self._windowed(x)
        return y if self.bias is None else y + self.bias[...]

    def _pointwise(self, x: Array) -> Array:
        return x[:, :: self.stride, :: self.stride] @ self.kernel[...][0, 0]

    def _windowed(self, x: Array) -> Array:
        pad = (self.size - 1) // 2
        return jax.lax.conv_general_dilated(
            x,
            self.kernel[...],
            window_strides=(self.stride, self.stride),
            padding=((pad, pad), (pad, pad)),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )


class ConvNorm(nnx.Module):
    """Convolution, batch norm and, unless told otherwise, ReLU."""

    def __init__(
        self,
        c_in: int,
        c_out: int,
        size: int,
        stride: int = 1,
        *,
        bias: bool = False,
        relu: bool = True,
        rngs: nnx.Rngs,
    ) -> None:
        self.conv = Conv(c_in, c_out, size, stride, bias=bias, rngs=rngs)
        self.norm = MaskedBatchNorm(c_out)
        self.relu = relu

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Convolve, normalise, rectify."""
        y = self.norm(self.conv(x), mode)
        return jax.nn.relu(y) if self.relu else y
