"""Trunks: one feature map per stride 4, 8, 16, 32 of an image, by HRNet or ResNet."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.core import Tracer

from poem_jax.models.config import FrozenNorms, HRNetConfig, ResNetConfig, Stem
from poem_jax.models.layers import ConvNorm, NormMode, TrunkRow, repeat_pixels
from poem_jax.typing import Array, Float

BOTTLENECK_EXPANSION = 4


class BasicBlock(nnx.Module):
    """Two 3 x 3 convolutions around a shortcut."""

    def __init__(
        self, c_in: int, c_out: int, stride: int = 1, *, frozen: bool = False, rngs: nnx.Rngs
    ) -> None:
        """`frozen`: the batch norms are never trained."""
        self.first = ConvNorm(c_in, c_out, 3, stride, frozen=frozen, rngs=rngs)
        self.second = ConvNorm(c_out, c_out, 3, relu=False, frozen=frozen, rngs=rngs)
        self.shortcut = _projection(c_in, c_out, stride, frozen, rngs)

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Apply the block."""
        y = self.second(self.first(x, mode), mode)
        return jax.nn.relu(y + (x if self.shortcut is None else self.shortcut(x, mode)))


class Bottleneck(nnx.Module):
    """1 x 1, 3 x 3 and 1 x 1 convolutions around a shortcut; the stride is in the 3 x 3."""

    def __init__(
        self, c_in: int, c_out: int, stride: int = 1, *, frozen: bool = False, rngs: nnx.Rngs
    ) -> None:
        """`frozen`: the batch norms are never trained."""
        inner = c_out // BOTTLENECK_EXPANSION
        self.reduce = ConvNorm(c_in, inner, 1, frozen=frozen, rngs=rngs)
        self.middle = ConvNorm(inner, inner, 3, stride, frozen=frozen, rngs=rngs)
        self.expand = ConvNorm(inner, c_out, 1, relu=False, frozen=frozen, rngs=rngs)
        self.shortcut = _projection(c_in, c_out, stride, frozen, rngs)

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Apply the block."""
        y = self.expand(self.middle(self.reduce(x, mode), mode), mode)
        return jax.nn.relu(y + (x if self.shortcut is None else self.shortcut(x, mode)))


def _projection(c_in: int, c_out: int, stride: int, frozen: bool, rngs: nnx.Rngs) -> ConvNorm | None:
    if stride == 1 and c_in == c_out:
        return None
    return ConvNorm(c_in, c_out, 1, stride, relu=False, frozen=frozen, rngs=rngs)


_Carry = TypeVar("_Carry")


def stacked_axes(path: Sequence[str]) -> int:
    """Count the leading axes, one per `Stack` around it, of the array at `path` in a model's parameters."""
    blocks = [i for i, part in enumerate(path) if part == "blocks"]
    return sum(not path[i + 1].isdigit() for i in blocks)


class Stack(TrunkRow):
    """`num_blocks` blocks of one kind applied one after the other, their weights stacked.

    At inference one `lax.scan` runs them: it compiles a block once instead of n times, and keeps XLA from
    recomputing residual chains inside large fusions. XLA:CPU, however, runs the gradients of convolutions
    inside a loop a hundred times slower than outside, so that training on a CPU unrolls the blocks.
    """

    def __init__(
        self, make_block: Callable[[nnx.Rngs], nnx.Module], num_blocks: int, *, rngs: nnx.Rngs
    ) -> None:
        self.num_blocks = num_blocks
        graphs, states = zip(*(nnx.split(make_block(rngs)) for _ in range(num_blocks)), strict=True)
        self.blocks = nnx.merge(graphs[0], jax.tree.map(_stack_weights, *states))

    def __call__(self, x: _Carry, mode: NormMode) -> _Carry:
        """Apply the blocks in order."""
        training_on_cpu = mode.training and jax.default_backend() == "cpu"
        return self.unrolled(x, mode) if training_on_cpu else self.scanned(x, mode)

    def scanned(self, x: _Carry, mode: NormMode) -> _Carry:
        """Apply the blocks in a loop."""

        @nnx.scan(in_axes=(nnx.Carry, 0), out_axes=nnx.Carry)
        def run(carry: _Carry, block: Callable[..., _Carry]) -> _Carry:
            return self.run(block, carry, mode)

        return run(x, self.blocks)

    def unrolled(self, x: _Carry, mode: NormMode) -> _Carry:
        """Apply the blocks one by one."""
        graph, weights = nnx.split(self.blocks)
        states = []
        for i in range(self.num_blocks):
            block: Any = nnx.merge(graph, jax.tree.map(lambda stacked, i=i: stacked[i], weights))
            x = self.run(block, x, mode)
            states.append(nnx.state(block))
        nnx.update(self.blocks, jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
        return x


def _stack_weights(*weights: Array) -> Array:
    """Stack arrays; NumPy compiles nothing for it."""
    if any(isinstance(array, Tracer) for array in weights):
        return jnp.stack(weights)
    return jnp.asarray(np.stack(weights))


_SPACE_TO_DEPTH = 4


class ResNet(TrunkRow):
    """Stem and stages of residual blocks."""

    def __init__(self, config: ResNetConfig, *, rngs: nnx.Rngs) -> None:
        make_stem = ConvolutionStem if config.stem is Stem.CONVOLUTION else SpaceToDepthStem
        frozen = config.frozen_norms is FrozenNorms.STAGE_STARTS
        self.stem = make_stem(config.stem_channels, frozen=frozen, rngs=rngs)
        widths = (config.stem_channels, *config.channels)
        block = Bottleneck if config.bottleneck else BasicBlock
        self.stages = nnx.List(
            Stage(block, widths[i], widths[i + 1], count, stride=1 if i == 0 else 2, frozen=frozen, rngs=rngs)
            for i, count in enumerate(config.blocks)
        )

    def __call__(self, images: Float[Array, "image h w 3"], mode: NormMode) -> tuple[Array, ...]:
        """Return the feature maps (image, h / s, w / s, c) for every stride s, finest first."""
        levels = [self.run(self.stem, images, mode)]
        for stage in self.stages:
            levels.append(stage(levels[-1], mode))
        return tuple(levels[1:])


class Stage(TrunkRow):
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
        frozen: bool = False,
        rngs: nnx.Rngs,
    ) -> None:
        """`frozen`: the first block's batch norms are never trained."""
        rest = [block(c_out, c_out, rngs=rngs) for _ in range(count - 1)]
        self.blocks = nnx.List([block(c_in, c_out, stride, frozen=frozen, rngs=rngs), *rest])

    def __call__(self, x: Float[Array, "image h w c"], mode: NormMode) -> Float[Array, "image h2 w2 c2"]:
        """Apply the stage."""
        for block in self.blocks:
            x = self.run(block, x, mode)
        return x


class ConvolutionStem(nnx.Module):
    """7 x 7 convolution of stride 2 and 3 x 3 max pooling of stride 2."""

    def __init__(self, channels: int, *, frozen: bool = False, rngs: nnx.Rngs) -> None:
        self.conv = ConvNorm(3, channels, 7, 2, frozen=frozen, rngs=rngs)

    def __call__(self, images: Float[Array, "image h w 3"], mode: NormMode) -> Float[Array, "image h2 w2 c"]:
        """Reach a quarter of the resolution."""
        x = self.conv(images, mode)
        padding = ((0, 0), (1, 1), (1, 1), (0, 0))
        return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), padding)


class SpaceToDepthStem(nnx.Module):
    """Every 4 x 4 pixels become one cell of 48 channels, then a 3 x 3 convolution."""

    def __init__(self, channels: int, *, frozen: bool = False, rngs: nnx.Rngs) -> None:
        self.conv = ConvNorm(3 * _SPACE_TO_DEPTH**2, channels, 3, frozen=frozen, rngs=rngs)

    def __call__(self, images: Float[Array, "image h w 3"], mode: NormMode) -> Float[Array, "image h2 w2 c"]:
        """Reach a quarter of the resolution."""
        s = _SPACE_TO_DEPTH
        image, h, w, c = images.shape
        cells = images.reshape(image, h // s, s, w // s, s, c).transpose(0, 1, 3, 2, 4, 5)
        return self.conv(cells.reshape(image, h // s, w // s, s * s * c), mode)


class HRNet(TrunkRow):
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
            x = self.run(conv, x, mode)
        x = self.layer1(self.run(self.widen, x, mode), mode)
        branches = self.stage2(tuple(self.run(start, x, mode) for start in self.transition1), mode)
        branches = self.stage3((*branches, self.run(self.transition2, branches[-1], mode)), mode)
        return self.stage4((*branches, self.run(self.transition3, branches[-1], mode)), mode)


def _module_maker(channels: tuple[int, ...], num_blocks: int) -> Any:
    return lambda rngs: ExchangeModule(channels, num_blocks, rngs=rngs)


class ExchangeModule(TrunkRow):
    """Residual blocks in every branch, then every branch receives the sum of all."""

    def __init__(self, channels: tuple[int, ...], num_blocks: int, *, rngs: nnx.Rngs) -> None:
        self.branches = nnx.List(Stack(_block_maker(c), num_blocks, rngs=rngs) for c in channels)
        self.fuse = nnx.List(Fusion(channels, target, rngs=rngs) for target in range(len(channels)))

    def __call__(self, maps: tuple[Array, ...], mode: NormMode) -> tuple[Array, ...]:
        """Apply the module to one map per branch."""
        maps = tuple(branch(x, mode) for branch, x in zip(self.branches, maps, strict=True))
        return tuple(self.run(fuse, maps, mode) for fuse in self.fuse)


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
