"""Layers of the two detection networks: plain functions over maps (image, h, w, channel) and stored weights.

Padding is TensorFlow's "SAME": what is missing is added evenly, the odd row and column at the bottom and
right. A depthwise convolution is a sum of shifted maps on a CPU, where XLA's own is ten times slower, and
XLA's convolution elsewhere; a 1 x 1 convolution is a matrix product.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from poem_jax.typing import Array, Float

_EXACT = lax.Precision.HIGHEST
"""On accelerators reduced products would move key points by 0.02 (TF32) to 0.2 pixels (bfloat16)."""


class Convolution(NamedTuple):
    """A full convolution."""

    kernel: Float[Array, "k k c_in c_out"]
    bias: Float[Array, "c_out"]


class Depthwise(NamedTuple):
    """One filter for each channel."""

    kernel: Float[Array, "k k c"]
    bias: Float[Array, "c"]


class Linear(NamedTuple):
    """A matrix product over channels: a 1 x 1 convolution, or a dense layer."""

    kernel: Float[Array, "c_in c_out"]
    bias: Float[Array, "c_out"]


def convolution_shapes(size: int, c_in: int, c_out: int) -> Convolution:
    """Return the shapes of a convolution's weights."""
    return Convolution(_shape(size, size, c_in, c_out), _shape(c_out))


def depthwise_shapes(size: int, channels: int, *stacked: int) -> Depthwise:
    """Return the shapes of a depthwise convolution's weights, with leading axes where `stacked`."""
    return Depthwise(_shape(*stacked, size, size, channels), _shape(*stacked, channels))


def linear_shapes(c_in: int, c_out: int, *stacked: int) -> Linear:
    """Return the shapes of a matrix and its bias, with leading axes where `stacked`."""
    return Linear(_shape(*stacked, c_in, c_out), _shape(*stacked, c_out))


def slope_shape(channels: int, *stacked: int) -> Any:
    """Return the shape of a PReLU's slopes."""
    return _shape(*stacked, channels)


def _shape(*shape: int) -> Any:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def convolve(x: Float[Array, "image h w c"], weights: Convolution, stride: int) -> Float[Array, "..."]:
    """Return a full convolution."""
    return _convolved(x, weights.kernel, stride) + weights.bias


def linear(x: Float[Array, "*batch c_in"], weights: Linear) -> Float[Array, "*batch c_out"]:
    """Return the matrix product over channels."""
    return jnp.matmul(x, weights.kernel, precision=_EXACT) + weights.bias


def depthwise(x: Float[Array, "image h w c"], weights: Depthwise, stride: int) -> Float[Array, "..."]:
    """Filter every channel by itself."""
    shifted, grouped = (partial(form, stride=stride) for form in (_by_shifts, _by_groups))
    return lax.platform_dependent(x, weights.kernel, cpu=shifted, default=grouped) + weights.bias


def prelu(x: Float[Array, "image h w c"], slope: Float[Array, "c"]) -> Float[Array, "image h w c"]:
    """Return x where positive, and slope x elsewhere."""
    return jnp.where(x > 0, x, slope * x)


def relu6(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Clip to [0, 6]."""
    return jnp.clip(x, 0, 6)


def twice_as_large(x: Float[Array, "image h w c"]) -> Float[Array, "image 2*h 2*w c"]:
    """Enlarge bilinearly, pixel centres at (i + 0.5) / n, the border repeated."""
    images, height, width, channels = x.shape
    return jax.image.resize(x, (images, 2 * height, 2 * width, channels), "bilinear", precision=_EXACT)


def _by_groups(x: Array, kernel: Array, stride: int) -> Array:
    return _convolved(x, kernel[:, :, None], stride, groups=x.shape[-1])


def _convolved(x: Array, kernel: Array, stride: int, groups: int = 1) -> Array:
    return lax.conv_general_dilated(
        x,
        kernel,
        (stride, stride),
        "SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        feature_group_count=groups,
        precision=_EXACT,
    )


def _by_shifts(x: Array, kernel: Array, stride: int) -> Array:
    size = kernel.shape[0]
    out = [-(-length // stride) for length in x.shape[1:3]]
    missing = [max((n - 1) * stride + size - length, 0) for n, length in zip(out, x.shape[1:3], strict=True)]
    around = [(m // 2, m - m // 2) for m in missing]
    x = jnp.pad(x, [(0, 0), *around, (0, 0)])
    total = jnp.zeros((x.shape[0], *out, x.shape[-1]), x.dtype)
    for row in range(size):
        for column in range(size):
            rows = slice(row, row + (out[0] - 1) * stride + 1, stride)
            columns = slice(column, column + (out[1] - 1) * stride + 1, stride)
            total = total + x[:, rows, columns] * kernel[row, column]
    return total
