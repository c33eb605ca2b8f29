"""The trunks of the releases: HRNet-W40 (v2) and ResNet-34 (v1), under the names of their checkpoints."""

from collections.abc import Callable

import torch  # pyright: ignore[reportMissingImports]
import torch.nn.functional as F  # pyright: ignore[reportMissingImports]
from torch import Tensor, nn  # pyright: ignore[reportMissingImports]

_NORM_EPSILON = 1e-5


class FrozenNorm(nn.Module):
    """Batch norm whose affine map, too, is fixed: all four arrays are buffers."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name, value in (("weight", 1.0), ("bias", 0.0), ("running_mean", 0.0), ("running_var", 1.0)):
            self.register_buffer(name, torch.full((channels,), value))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (image, c, h, w)."""
        scale = self.weight * (self.running_var + _NORM_EPSILON).rsqrt()
        shift = self.bias - self.running_mean * scale
        return x * scale[:, None, None] + shift[:, None, None]


Norm = Callable[[int], nn.Module]


def _conv(c_in: int, c_out: int, size: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(c_in, c_out, size, stride, size // 2, bias=False)


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions and a shortcut, which is a 1 x 1 convolution where the shape changes."""

    def __init__(self, c_in: int, c_out: int, stride: int = 1, norm: Norm = nn.BatchNorm2d) -> None:
        super().__init__()
        self.conv1, self.bn1 = _conv(c_in, c_out, 3, stride), norm(c_out)
        self.conv2, self.bn2 = _conv(c_out, c_out, 3), norm(c_out)
        same = c_in == c_out and stride == 1
        self.downsample = None if same else nn.Sequential(_conv(c_in, c_out, 1, stride), norm(c_out))

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, c_in, h, w) to (image, c_out, h / stride, w / stride)."""
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = self.bn2(self.conv2(y))
        y += x if self.downsample is None else self.downsample(x)
        return F.relu(y, inplace=True)


class Bottleneck(nn.Module):
    """1 x 1, 3 x 3 and 1 x 1 convolution, and a shortcut."""

    def __init__(self, c_in: int, middle: int, c_out: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = _conv(c_in, middle, 1), nn.BatchNorm2d(middle)
        self.conv2, self.bn2 = _conv(middle, middle, 3), nn.BatchNorm2d(middle)
        self.conv3, self.bn3 = _conv(middle, c_out, 1), nn.BatchNorm2d(c_out)
        same = c_in == c_out
        self.downsample = None if same else nn.Sequential(_conv(c_in, c_out, 1), nn.BatchNorm2d(c_out))

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, c_in, h, w) to (image, c_out, h, w)."""
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = F.relu(self.bn2(self.conv2(y)), inplace=True)
        y = self.bn3(self.conv3(y))
        y += x if self.downsample is None else self.downsample(x)
        return F.relu(y, inplace=True)


# HRNet.

_CHANNELS = (40, 80, 160, 320)
_MODULES = (1, 4, 3)
_BLOCKS = 4
_STEM, _WIDE = 64, 256


def _conv_norm(c_in: int, c_out: int, size: int, stride: int = 1, *, relu: bool = True) -> nn.Sequential:
    layers = [_conv(c_in, c_out, size, stride), nn.BatchNorm2d(c_out)]
    return nn.Sequential(*layers, *([nn.ReLU(inplace=True)] if relu else []))


def _reduction(c_in: int, c_out: int, halvings: int) -> nn.Sequential:
    """3 x 3 convolutions of stride 2; the width changes in the last, which has no ReLU."""
    steps = [_conv_norm(c_in, c_in, 3, 2) for _ in range(halvings - 1)]
    return nn.Sequential(*steps, _conv_norm(c_in, c_out, 3, 2, relu=False))


def _enlargement(c_in: int, c_out: int, factor: int) -> nn.Sequential:
    """1 x 1 convolution, then repeated pixels."""
    layers = _conv_norm(c_in, c_out, 1, relu=False)
    return nn.Sequential(*layers, nn.Upsample(scale_factor=factor, mode="nearest"))


class ExchangeModule(nn.Module):
    """Residual blocks in every branch, then every branch receives the sum of all."""

    def __init__(self, channels: tuple[int, ...]) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            nn.Sequential(*(BasicBlock(c, c) for _ in range(_BLOCKS))) for c in channels
        )
        branches = range(len(channels))
        self.fuse_layers = nn.ModuleList(
            nn.ModuleList(self._path(channels, origin, target) for origin in branches) for target in branches
        )

    @staticmethod
    def _path(channels: tuple[int, ...], origin: int, target: int) -> nn.Module:
        if origin == target:
            return nn.Identity()
        make, count = (
            (_enlargement, 2 ** (origin - target)) if origin > target else (_reduction, target - origin)
        )
        return make(channels[origin], channels[target], count)

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        """Apply the module to one map (image, c, h, w) per branch."""
        maps = [branch(x) for branch, x in zip(self.branches, maps, strict=True)]
        return [F.relu(self._fused(paths, maps), inplace=True) for paths in self.fuse_layers]

    @staticmethod
    def _fused(paths: nn.ModuleList, maps: list[Tensor]) -> Tensor:
        total = paths[0](maps[0])
        for path, x in zip(paths[1:], maps[1:], strict=True):
            total = total + path(x)
        return total


class HRNet(nn.Module):
    """Stem, four bottlenecks, and three stages of exchange modules over 2, 3 and 4 branches."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = _conv(3, _STEM, 3, 2), nn.BatchNorm2d(_STEM)
        self.conv2, self.bn2 = _conv(_STEM, _STEM, 3, 2), nn.BatchNorm2d(_STEM)
        widths = (_STEM, *[_WIDE] * (_BLOCKS - 1))
        self.layer1 = nn.Sequential(*(Bottleneck(c, _STEM, _WIDE) for c in widths))
        first, second = _CHANNELS[:2]
        self.transition1 = nn.ModuleList(
            [_conv_norm(_WIDE, first, 3), nn.Sequential(_conv_norm(_WIDE, second, 3, 2))]
        )
        self.transition2, self.transition3 = _new_branch(2), _new_branch(3)
        self.stage2, self.stage3, self.stage4 = (
            nn.Sequential(*(ExchangeModule(_CHANNELS[: i + 2]) for _ in range(count)))
            for i, count in enumerate(_MODULES)
        )

    def forward(self, images: Tensor) -> list[Tensor]:
        """Map (image, 3, h, w) to (image, c, h / s, w / s) for s = 4, 8, 16, 32."""
        x = F.relu(self.bn1(self.conv1(images)), inplace=True)
        x = self.layer1(F.relu(self.bn2(self.conv2(x)), inplace=True))
        maps = self.stage2([start(x) for start in self.transition1])
        maps = self.stage3([*maps, self.transition2[-1](maps[-1])])
        return self.stage4([*maps, self.transition3[-1](maps[-1])])


def _new_branch(number: int) -> nn.ModuleList:
    """Make branch `number` of the coarsest one; it stands at its number in the list."""
    start = nn.Sequential(_conv_norm(_CHANNELS[number - 1], _CHANNELS[number], 3, 2))
    return nn.ModuleList([*(nn.Identity() for _ in range(number)), start])


# ResNet.

_STAGES = ((64, 3), (128, 4), (256, 6), (512, 3))
"""Channels and blocks."""


class ResNet34(nn.Module):
    """ResNet-34 whose stem, shortcuts and first blocks of stages have frozen norms."""

    def __init__(self) -> None:
        super().__init__()
        c_in = _STAGES[0][0]
        self.conv1, self.bn1 = nn.Conv2d(3, c_in, 7, 2, 3, bias=False), FrozenNorm(c_in)
        for i, (channels, count) in enumerate(_STAGES):
            first = BasicBlock(c_in, channels, 1 if i == 0 else 2, FrozenNorm)
            rest = (BasicBlock(channels, channels) for _ in range(count - 1))
            self.add_module(f"layer{i + 1}", nn.Sequential(first, *rest))
            c_in = channels

    def forward(self, images: Tensor) -> list[Tensor]:
        """Map (image, 3, h, w) to (image, c, h / s, w / s) for s = 4, 8, 16, 32."""
        x = F.relu(self.bn1(self.conv1(images)), inplace=True)
        levels = [F.max_pool2d(x, 3, 2, 1)]
        for i in range(len(_STAGES)):
            levels.append(self.get_submodule(f"layer{i + 1}")(levels[-1]))
        return levels[1:]
