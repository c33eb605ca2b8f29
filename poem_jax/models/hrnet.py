"""HRNet trunk (Wang et al. 2020): parallel branches at strides 4, 8, 16, 32 that exchange their maps."""

from typing import Any

import jax
from flax import nnx

from poem_jax.models.batch_norm import NormMode
from poem_jax.models.config import HRNetConfig
from poem_jax.models.convolution import ConvNorm
from poem_jax.models.resampling import repeat_pixels
from poem_jax.models.residual import BOTTLENECK_EXPANSION, BasicBlock, Bottleneck
from poem_jax.models.stack import Stack
from poem_jax.typing import Array, Float


class HRNet(nnx.Module):
    """Stem, four bottlenecks, and three stages of exchange modules over 2, 3 and 4 branches."""

    def __init__(self, config: HRNetConfig, *, rngs: nnx.Rngs) -> None:
        stem, channels = config.stem_channels, config.channels
        wide = stem * BOTTLENECK_EXPANSION
        self.stem = nnx.List([ConvNorm(3, stem, 3, 2, rngs=rngs), ConvNorm(stem, stem, 3, 2, rngs=rngs)])
        self.widen = Bottleneck(stem, wide, rngs=rngs)
        rest = config.stem_blocks - 1
        self.layer1 = Stack(lambda rngs: Bottleneck(wide, wide, rngs=rngs), rest, rngs=rngs)
        self.transition1 = nnx.List(
            [ConvNorm(wide, channels[0], 3, rngs=rngs), ConvNorm(wide, channels[1], 3, 2, rngs=rngs)]
        )
        self.transition2 = ConvNorm(channels[1], channels[2], 3, 2, rngs=rngs)
        self.transition3 = ConvNorm(channels[2], channels[3], 3, 2, rngs=rngs)
        self.stage2, self.stage3, self.stage4 = (
            Stack(_module_maker(channels[: i + 2], config.blocks), count, rngs=rngs)
            for i, count in enumerate(config.modules)
        )

    def __call__(self, images: Float[Array, "image h w 3"], mode: NormMode) -> tuple[Array, ...]:
        """Return the feature maps (image, h / s, w / s, c) for s = 4, 8, 16, 32."""
        x = images
        for conv in self.stem:
            x = conv(x, mode)
        x = self.layer1(self.widen(x, mode), mode)
        branches = self.stage2(tuple(start(x, mode) for start in self.transition1), mode)
        branches = self.stage3((*branches, self.transition2(branches[-1], mode)), mode)
        return self.stage4((*branches, self.transition3(branches[-1], mode)), mode)


def _module_maker(channels: tuple[int, ...], num_blocks: int) -> Any:
    return lambda rngs: ExchangeModule(channels, num_blocks, rngs=rngs)


class ExchangeModule(nnx.Module):
    """Residual blocks in every branch, then every branch receives the sum of all."""

    def __init__(self, channels: tuple[int, ...], num_blocks: int, *, rngs: nnx.Rngs) -> None:
        self.branches = nnx.List(Stack(_block_maker(c), num_blocks, rngs=rngs) for c in channels)
        self.fuse = nnx.List(Fusion(channels, target, rngs=rngs) for target in range(len(channels)))

    def __call__(self, maps: tuple[Array, ...], mode: NormMode) -> tuple[Array, ...]:
        """Apply the module to one map per branch."""
        maps = tuple(branch(x, mode) for branch, x in zip(self.branches, maps, strict=True))
        return tuple(fuse(maps, mode) for fuse in self.fuse)


def _block_maker(channels: int) -> Any:
    return lambda rngs: BasicBlock(channels, channels, rngs=rngs)


class Fusion(nnx.Module):
    """Bring all branches to the resolution and width of one, and sum them."""

    def __init__(self, channels: tuple[int, ...], target: int, *, rngs: nnx.Rngs) -> None:
        self.target = target
        self.paths = nnx.List(
            self._path(channels, source, rngs) for source in range(len(channels)) if source != target
        )

    def _path(self, channels: tuple[int, ...], source: int, rngs: nnx.Rngs) -> "Enlarge | Reduce":
        if source > self.target:
            factor = 2 ** (source - self.target)
            return Enlarge(channels[source], channels[self.target], factor, rngs=rngs)
        return Reduce(channels[source], channels[self.target], self.target - source, rngs=rngs)

    def __call__(self, maps: tuple[Array, ...], mode: NormMode) -> Array:
        """Return the fused map of the target branch."""
        others = [x for source, x in enumerate(maps) if source != self.target]
        moved = [path(x, mode) for path, x in zip(self.paths, others, strict=True)]
        return jax.nn.relu(sum(moved, maps[self.target]))


class Enlarge(nnx.Module):
    """1 x 1 convolution, then repeated pixels."""

    def __init__(self, c_in: int, c_out: int, factor: int, *, rngs: nnx.Rngs) -> None:
        self.factor = factor
        self.conv = ConvNorm(c_in, c_out, 1, relu=False, rngs=rngs)

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Bring a coarse map to a finer branch."""
        return repeat_pixels(self.conv(x, mode), self.factor)


class Reduce(nnx.Module):
    """3 x 3 convolutions of stride 2; the width changes in the last, which has no ReLU."""

    def __init__(self, c_in: int, c_out: int, halvings: int, *, rngs: nnx.Rngs) -> None:
        keep = [ConvNorm(c_in, c_in, 3, 2, rngs=rngs) for _ in range(halvings - 1)]
        self.convs = nnx.List([*keep, ConvNorm(c_in, c_out, 3, 2, relu=False, rngs=rngs)])

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Bring a fine map to a coarser branch."""
        for conv in self.convs:
            x = conv(x, mode)
        return x
