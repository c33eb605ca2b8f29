"""Layers that trunks, branches and decoder are built of; maps are NHWC.

Flax's own stand in the decoder. Ours are those that win: batch norm over the views that exist, 1 x 1
convolutions as matrix products and enlargements as broadcasts, several times faster on a CPU.

A layer computes in the number type of its weights, whatever it is given (`in_type_of_weights`), so that the
weights alone say what a model computes in; `precision.py` casts them. `Exact` ones are never cast.

What is inside the blocks of a `Row` can be computed again in the backward pass, instead of being kept for it:
only what goes into a block is then kept, for the time of one more forward pass; the gradients are the same.

Weights are drawn by NumPy, seeded by the JAX key: compiling JAX's generators for every shape of a large model
takes a minute. Under a trace JAX draws them: other numbers of the same distribution.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.core import Tracer

from poem_jax.models import winograd
from poem_jax.models.config import ModelConfig
from poem_jax.typing import Array, Bool, Float, Num, PRNGKeyArray

BATCH_NORM_EPSILON = 1e-5
BATCH_NORM_MOMENTUM = 0.1
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


class Exact(nnx.Param):
    """A weight that keeps its precision where others are cast: of a norm, or of a layer that gives
    coordinates or a logit. So what it gives is in float32, too."""


class PerQuery(nnx.Param):
    """A learned vector for each query: of the 799 points, in the system's own order of them, or of the 21
    joints."""


_Arrays = TypeVar("_Arrays", bound=tuple)


def in_type_of_weights(arrays: _Arrays, /, *, dtype: Any = None, inexact: bool = True) -> _Arrays:
    """Cast (inputs, kernel, bias or None) to the kernel's type, as `nnx.Linear` asks; the rest is of no
    account."""
    kernel = arrays[1]
    return tuple(None if x is None else jnp.asarray(x, kernel.dtype) for x in arrays)  # pyright: ignore[reportReturnType]


class Row(nnx.Module):
    """What calls blocks one after the other."""

    recomputed = False
    """Whether the insides of its blocks are computed again."""

    def run(self, block: Callable[..., Any], *args: Any) -> Any:
        """Call a block, a module; a row among the blocks decides about its own."""
        if not self.recomputed or isinstance(block, Row):
            return block(*args)
        return nnx.remat(lambda block: block(*args))(block)

    def lean(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of arrays that keeps none of its inside, or as it is."""
        return jax.checkpoint(function) if self.recomputed else function  # pyright: ignore[reportPrivateImportUsage]


class TrunkRow(Row):
    """A row in what is done with every view alone."""


class DecoderRow(Row):
    """A row in what joins the views to a hand."""


def recompute(model: object, kinds: tuple[type[Row], ...]) -> None:
    """Let all rows of these kinds compute the insides of their blocks again."""
    for _, part in nnx.iter_graph(model) if kinds else ():
        if isinstance(part, kinds):
            part.recomputed = True


def trunk_images(
    views: Num[Array, "*batch h w 3"], config: ModelConfig, dtype: Any
) -> Float[Array, "image h w 3"]:
    """Return views, uint8 or float in [0, 1], as the trunk of a model takes them: in one row, about the
    config's mean and over its standard deviation."""
    scale = 255.0 if views.dtype == jnp.uint8 else 1.0
    images = jnp.asarray(views.reshape(-1, *views.shape[-3:]), dtype) / scale
    return (images - config.image_mean) / config.image_std


class MaskedBatchNorm(nnx.Module):
    """Per-channel batch norm (Ioffe and Szegedy 2015) by the moments of the valid images.

    Padded views hold no image. With an `axis_name` the images are those of all devices of a `pmap` or
    `shard_map`.
    """

    def __init__(self, channels: int) -> None:
        self.scale, self.bias = Exact(filled(1.0, channels)), Exact(filled(0.0, channels))
        self.mean, self.variance = nnx.BatchStat(filled(0.0, channels)), nnx.BatchStat(filled(1.0, channels))

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h w c"]:
        """Normalise; in training also move the running statistics."""
        mean, variance = self.mean[...], self.variance[...]
        if mode.image_mask is not None:
            mean, variance, count = masked_moments(x, mode.image_mask, mode.axis_name)
            self._move_towards(mean, variance, count)
        gain = self.scale[...] * jax.lax.rsqrt(variance + BATCH_NORM_EPSILON)
        return (x * gain + (self.bias[...] - mean * gain)).astype(x.dtype)

    def _move_towards(self, mean: Array, variance: Array, count: Array) -> None:
        share = jnp.where(count > 0, BATCH_NORM_MOMENTUM, 0.0)
        unbiased = variance * count / jnp.maximum(count - 1.0, 1.0)
        self.mean[...] += jax.lax.stop_gradient(share * (mean - self.mean[...]))
        self.variance[...] += jax.lax.stop_gradient(share * (unbiased - self.variance[...]))


class FrozenBatchNorm(nnx.Module):
    """Batch norm that stays as the trunk was pre-trained: its scale and bias are constants among the
    statistics, and training neither uses nor moves moments."""

    def __init__(self, channels: int) -> None:
        self.scale, self.bias = nnx.BatchStat(filled(1.0, channels)), nnx.BatchStat(filled(0.0, channels))
        self.mean, self.variance = nnx.BatchStat(filled(0.0, channels)), nnx.BatchStat(filled(1.0, channels))

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h w c"]:
        """Normalise by the running statistics, whatever the mode."""
        scale, bias, mean, variance = (
            jax.lax.stop_gradient(leaf[...]) for leaf in (self.scale, self.bias, self.mean, self.variance)
        )
        gain = scale * jax.lax.rsqrt(variance + BATCH_NORM_EPSILON)
        return (x * gain + (bias - mean * gain)).astype(x.dtype)


def masked_moments(
    x: Float[Array, "image h w c"], image_mask: Bool[Array, " image"], axis_name: str | None = None
) -> tuple[Float[Array, " c"], Float[Array, " c"], Float[Array, ""]]:
    """Return mean, biased variance and number of pixels over the valid images, in float32 at least; without
    any: 0, 0, 0.

    In two passes: the mean of the squares less the square of the mean would lose all digits of a variance
    that is small beside the mean.
    """
    mask, x = image_mask[:, None, None, None], at_least_float32(x)

    def total(values: Array) -> Array:
        summed = jnp.sum(jnp.where(mask, values, 0), (0, 1, 2))
        return summed if axis_name is None else jax.lax.psum(summed, axis_name)

    count = total(jnp.ones((*x.shape[:3], 1), x.dtype))[0]
    mean = total(x) / jnp.maximum(count, 1.0)
    return mean, total((x - mean) ** 2) / jnp.maximum(count, 1.0), count


_FILTERED_CHANNELS, _FILTERED_SIZE = range(40, 257), 2**15
"""Where minimal filtering is faster on a CPU: by channels, and by channels times pixels of the least map. Of
fewer channels no matrix product is filled, of more the kernel, which grows, takes most of the time to read;
on smaller maps (64 channels on 16 x 16) both are equally fast."""
_LEAST_GRADIENT_CHANNELS = 32
"""Where minimal filtering is the faster gradient of a kernel on a CPU (docs/performance.md, "A training
step"): from so many channels on, and where there are at least as many tiles as channels."""


class Conv(nnx.Module):
    """Square convolution with padding (size - 1) / 2; size 1 is a matrix product, far faster on a CPU."""

    def __init__(
        self,
        c_in: int,
        c_out: int,
        size: int,
        stride: int = 1,
        *,
        bias: bool = False,
        exact: bool = False,
        rngs: nnx.Rngs,
    ) -> None:
        """`exact`: with `Exact` weights."""
        self.stride, self.size = stride, size
        weight = Exact if exact else nnx.Param
        self.kernel = weight(he_normal(rngs.params(), (size, size, c_in, c_out)))
        self.bias = weight(filled(0.0, c_out)) if bias else None

    def __call__(
        self, x: Float[Array, "image h w c"], *, training: bool = False
    ) -> Float[Array, "image h2 w2 c2"]:
        """Convolve. In `training` gradients may have a form of their own, which knows no forward mode and, in
        a `shard_map`, wants `check_vma=False`."""
        x = x.astype(self.kernel[...].dtype)
        y = self._pointwise(x) if self.size == 1 else self._windowed(x, training)
        return y if self.bias is None else y + self.bias[...]

    def prepare_for_cpu(self, pixels: int) -> None:
        """Transform the kernel, once and for all, where minimal filtering is faster on a CPU.

        `pixels`: of the smallest map that it is used on.
        """
        kernel = self.kernel[...]
        filtered = all(channels in _FILTERED_CHANNELS for channels in kernel.shape[-2:])
        large = min(kernel.shape[-2:]) * pixels >= _FILTERED_SIZE
        if self.size == 3 and self.stride == 1 and filtered and large:
            self.kernel = nnx.Param(winograd.transformed(kernel))

    def _pointwise(self, x: Array) -> Array:
        return x[:, :: self.stride, :: self.stride] @ self.kernel[...][0, 0]

    def _windowed(self, x: Array, training: bool) -> Array:
        kernel = self.kernel[...]
        if len(kernel) == winograd.TILE:
            return winograd.convolve(x, kernel)
        if training and self.size == 3 and self.stride == 1 and _filters_gradients(x, kernel):
            return _trained_convolution(x, kernel)
        return convolve(x, kernel, self.stride)


def convolve(
    x: Float[Array, "image h w c_in"], kernel: Float[Array, "size size c_in c_out"], stride: int = 1
) -> Float[Array, "image h2 w2 c_out"]:
    """Convolve with (size - 1) / 2 pixels of zeros around the image."""
    pad = (len(kernel) - 1) // 2
    return jax.lax.conv_general_dilated(
        x,
        kernel,
        window_strides=(stride, stride),
        padding=((pad, pad), (pad, pad)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )


def _filters_gradients(x: Array, kernel: Array) -> bool:
    """Whether minimal filtering is the faster gradient of a kernel on a CPU."""
    channels, tiles = kernel.shape[-2:], x.size // x.shape[-1] // 4
    return min(channels) >= _LEAST_GRADIENT_CHANNELS and tiles >= max(channels)


@jax.custom_vjp
def _trained_convolution(x: Array, kernel: Array) -> Array:
    """Convolve 3 x 3; on a CPU the gradient of the kernel goes by minimal filtering."""
    return convolve(x, kernel)


def _trained_forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return convolve(x, kernel), (x, kernel)


def _trained_backward(kept: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel = kept
    of_kernel = jax.lax.platform_dependent(
        x, gradient, cpu=winograd.kernel_gradient, default=_plain_kernel_gradient
    )
    return jax.vjp(lambda x: convolve(x, kernel), x)[1](gradient)[0], of_kernel


def _plain_kernel_gradient(x: Array, gradient: Array) -> Array:
    """Return the gradient of a 3 x 3 kernel as the compiler has it."""
    kernel = jnp.zeros((3, 3, x.shape[-1], gradient.shape[-1]), x.dtype)
    return jax.vjp(lambda kernel: convolve(x, kernel), kernel)[1](gradient)[0]


_trained_convolution.defvjp(_trained_forward, _trained_backward)


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
        frozen: bool = False,
        rngs: nnx.Rngs,
    ) -> None:
        """`frozen`: the batch norm is never trained."""
        self.conv = Conv(c_in, c_out, size, stride, bias=bias, rngs=rngs)
        self.norm = (FrozenBatchNorm if frozen else MaskedBatchNorm)(c_out)
        self.relu = relu

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Convolve, normalise, rectify."""
        y = self.norm(self.conv(x, training=mode.training), mode)
        return jax.nn.relu(y) if self.relu else y


class TopDownBranch(TrunkRow):
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
            x = self.run(merge, jnp.concatenate([double_bilinear(x), finer], -1), mode)
        return x


def repeat_pixels(x: Float[Array, "image h w c"], factor: int) -> Float[Array, "image h2 w2 c"]:
    """Enlarge by repeating every pixel (nearest neighbour)."""
    image, h, w, c = x.shape
    tiled = jnp.broadcast_to(x[:, :, None, :, None], (image, h, factor, w, factor, c))
    return tiled.reshape(image, h * factor, w * factor, c)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def max_pool(x: Float[Array, "image h w c"], factor: int) -> Float[Array, "image h2 w2 c"]:
    """Reduce to the largest of every `factor` x `factor` pixels."""
    return jnp.max(_cells(x, factor), (2, 4))


@max_pool.defjvp
def _max_pool_jvp(factor: int, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    """Differentiate the maxima of two by two.

    The gradient of one maximum of many looks for the number that equals it, and where a compiler computes
    that number twice, rounded differently, none does and the gradient is 0 / 0.
    """

    def two_by_two(x: Array) -> Array:
        cells = _cells(x, factor)
        rows = functools.reduce(jnp.maximum, (cells[:, :, i] for i in range(factor)))
        return functools.reduce(jnp.maximum, (rows[..., i, :] for i in range(factor)))

    return jax.jvp(two_by_two, primals, tangents)


def _cells(x: Array, factor: int) -> Array:
    image, h, w, c = x.shape
    return x.reshape(image, h // factor, factor, w // factor, factor, c)


def double_bilinear(x: Float[Array, "image h w c"]) -> Float[Array, "image h2 w2 c"]:
    """Double the resolution bilinearly: pixel areas are split, samples beyond the border repeat the edge."""
    return _double_axis(_double_axis(x, 1), 2)


def _double_axis(x: Array, axis: int) -> Array:
    """New samples stand a quarter cell before and after each old centre, hence the weights 3/4 and 1/4."""
    size = x.shape[axis]
    first, last = (jnp.take(x, jnp.array([i]), axis=axis) for i in (0, size - 1))
    body = [slice(None)] * x.ndim
    body[axis] = slice(0, size - 1)
    before = jnp.concatenate([first, x[tuple(body)]], axis)
    body[axis] = slice(1, size)
    after = jnp.concatenate([x[tuple(body)], last], axis)
    pair = jnp.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after], axis + 1)
    return pair.reshape(*x.shape[:axis], 2 * size, *x.shape[axis + 1 :])


def linear(
    c_in: int, c_out: int, *, bias: bool = True, exact: bool = False, zero: bool = False, rngs: nnx.Rngs
) -> nnx.Linear:
    """Make an affine map of the last axis, drawn by `xavier_uniform`, or `zero` at first; `exact`: with
    `Exact` weights."""
    layer = nnx.Linear(
        c_in,
        c_out,
        use_bias=bias,
        kernel_init=nnx.initializers.zeros if zero else xavier_uniform,
        promote_dtype=in_type_of_weights,
        rngs=rngs,
    )
    if exact:
        layer.kernel = Exact(layer.kernel[...])
        if layer.bias is not None:
            layer.bias = Exact(layer.bias[...])
    return layer


def layer_norm(channels: int, epsilon: float, *, rngs: nnx.Rngs) -> nnx.LayerNorm:
    """Make a normalisation of the last axis (Ba et al. 2016), its variance in two passes; the result has the
    type of what is normalised."""
    layer = _LayerNorm(channels, epsilon=epsilon, use_fast_variance=False, rngs=rngs)
    layer.scale, layer.bias = Exact(filled(1.0, channels)), Exact(filled(0.0, channels))
    return layer


class _LayerNorm(nnx.LayerNorm):
    def __call__(self, x: Float[Array, "*batch c"], **options: Any) -> Float[Array, "*batch c"]:
        return super().__call__(x, **options).astype(x.dtype)


def at_least_float32(x: Array) -> Array:
    """Cast half numbers to float32, for sums and exponentials that would lose their digits."""
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def dropout(x: Float[Array, "*shape"], rate: float, key: PRNGKeyArray | None) -> Float[Array, "*shape"]:
    """Set a share of the numbers to zero and enlarge the rest in proportion; without a key, do nothing."""
    if key is None or rate == 0:
        return x
    return jnp.where(jax.random.bernoulli(key, 1 - rate, x.shape), x / (1 - rate), 0)


def filled(value: float, channels: int) -> Float[Array, " c"]:
    """Return equal numbers; through NumPy, which compiles nothing for it."""
    return jnp.asarray(np.full((channels,), value, np.float32))


def normal(key: PRNGKeyArray, shape: tuple[int, ...], scale: float = 1.0) -> Float[Array, "*shape"]:
    """Draw from a normal distribution with standard deviation `scale`."""
    if isinstance(key, Tracer):
        return scale * jax.random.normal(key, shape, jnp.float32)
    return jnp.asarray(scale * _numpy_generator(key).standard_normal(shape, np.float32))


def uniform(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "*shape"]:
    """Draw evenly from [0, 1)."""
    if isinstance(key, Tracer):
        return jax.random.uniform(key, shape, jnp.float32)
    return jnp.asarray(_numpy_generator(key).random(shape, np.float32))


def he_normal(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "*shape"]:
    """Draw weights (..., c_out) from N(0, 2 / fan-in) (He et al. 2015)."""
    return normal(key, shape, math.sqrt(2 / math.prod(shape[:-1])))


def xavier_uniform(
    key: PRNGKeyArray, shape: tuple[int, int], dtype: Any = jnp.float32
) -> Float[Array, "c_in c_out"]:
    """Draw weights uniformly with variance 2 / (fan-in + fan-out) (Glorot and Bengio 2010)."""
    limit = math.sqrt(6 / sum(shape))
    if isinstance(key, Tracer):
        return jax.random.uniform(key, shape, dtype, -limit, limit)
    return jnp.asarray(limit * (2 * _numpy_generator(key).random(shape, np.float32) - 1), dtype)


def _numpy_generator(key: PRNGKeyArray) -> np.random.Generator:
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))
