"""ResNet trunk: one feature map per stage, at strides 4, 8, 16, 32."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.batch_norm import NormMode
from poem_jax.models.config import ResNetConfig, Stem
from poem_jax.models.convolution import ConvNorm
from poem_jax.models.residual import BasicBlock, Bottleneck
from poem_jax.typing import Array, Float

_SPACE_TO_DEPTH = 4


class ResNet(nnx.Module):
    """Stem and stages of residual blocks."""

    def __init__(self, config: ResNetConfig, *, rngs: nnx.Rngs) -> None:
        make_stem = ConvolutionStem if config.stem is Stem.CONVOLUTION else SpaceToDepthStem
        self.stem = make_stem(config.stem_channels, rngs=rngs)
        widths = (config.stem_channels, *config.channels)
        block = Bottleneck if config.bottleneck else BasicBlock
        self.stages = nnx.List(
            Stage(block, widths[i], widths[i + 1], count, stride=1 if i == 0 else 2, rngs=rngs)
            for i, count in enumerate(config.blocks)
        )

    def __call__(self, images: Float[Array, "image h w 3"], mode: NormMode) -> tuple[Array, ...]:
        """Return the feature maps (image, h / s, w / s, c) for every stride s, finest first."""
        levels = [self.stem(images, mode)]
        for stage in self.stages:
            levels.append(stage(levels[-1], mode))
        return tuple(levels[1:])


class Stage(nnx.Module):
    """A block that changes stride and width, then identical blocks.

    Not a `Stack`: XLA:CPU runs the gradients of convolutions inside a loop a hundred times slower.
    """

    def __init__(
        self,
        block: Callable[..., nnx.Module],
        c_in: int,
        c_out: int,
        count: int,
        *,
        stride: int,
        rngs: nnx.Rngs,
    ) -> None:
        rest = [block(c_out, c_out, rngs=rngs) for _ in range(count - 1)]
        self.blocks = nnx.List([block(c_in, c_out, stride, rngs=rngs), *rest])

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Apply the stage."""
        for block in self.blocks:
            x = block(x, mode)
        return x


class ConvolutionStem(nnx.Module):
    """7 x 7 convolution of stride 2 and 3 x 3 max pooling of stride 2."""

    def __init__(self, channels: int, *, rngs: nnx.Rngs) -> None:
        self.conv = ConvNorm(3, channels, 7, 2, rngs=rngs)

    def __call__(self, images: Float[Array, "image h w 3"], mode: NormMode) -> Float[Array, "image h2 w2 c"]:
        """Reach a quarter of the resolution."""
        x = self.conv(images, mode)
        padding = ((0, 0), (1, 1), (1, 1), (0, 0))
        return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), padding)


class SpaceToDepthStem(nnx.Module):
    """Every 4 x 4 pixels become one cell of 48 channels, then a 3 x 3 convolution."""

    def __init__(self, channels: int, *, rngs: nnx.Rngs) -> None:
        self.conv = ConvNorm(3 * _SPACE_TO_DEPTH**2, channels, 3, rngs=rngs)

    def __call__(self, images: Float[Array, "image h w 3"], mode: NormMode) -> Float[Array, "image h2 w2 c"]:
        """Reach a quarter of the resolution."""
        s = _SPACE_TO_DEPTH
        image, h, w, c = images.shape
        cells = images.reshape(image, h // s, s, w // s, s, c).transpose(0, 1, 3, 2, 4, 5)
        return self.conv(cells.reshape(image, h // s, w // s, s * s * c), mode)
