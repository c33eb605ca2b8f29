"""The landmark network (MediaPipe Hands, "hand landmark full"): a crop of a hand in, its 21 key points out.

    224 x 224 x 3
      stem, stride 2 -> 112 x 112 x 24
      16 inverted bottlenecks (MobileNetV2's) -> 7 x 7 x 1152
      mean over the map -> key points, presence, side

A bottleneck widens the channels, filters each by itself, and narrows them again; where size and width stay,
its input is added.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import nn

from poem_jax.detection.layers import (
    Convolution,
    Depthwise,
    Linear,
    convolution_shapes,
    convolve,
    depthwise,
    depthwise_shapes,
    linear,
    linear_shapes,
    relu6,
)
from poem_jax.typing import Array, Float

INPUT_SIZE = 224


class Bottleneck(NamedTuple):
    """Widen, filter, narrow; the first does not widen, the last does not narrow."""

    widen: Linear | None
    filter: Depthwise
    narrow: Linear | None


class LandmarkWeights(NamedTuple):
    """Weights of the landmark network."""

    stem: Convolution
    bottlenecks: tuple[Bottleneck, ...]
    handedness: Linear
    presence: Linear
    points: Linear


class _Size(NamedTuple):
    """Of a bottleneck."""

    wide: int
    """Channels that are filtered."""
    filter: int
    stride: int
    out: int
    times: int = 1


_SIZES = (
    _Size(24, 3, 1, 16),
    _Size(64, 3, 2, 24),
    _Size(144, 3, 1, 24),
    _Size(144, 5, 2, 40),
    _Size(240, 5, 1, 40),
    _Size(240, 3, 2, 80),
    _Size(480, 3, 1, 80, times=2),
    _Size(480, 5, 1, 112),
    _Size(672, 5, 1, 112, times=2),
    _Size(672, 5, 2, 192),
    _Size(1152, 5, 1, 192, times=3),
    _Size(1152, 3, 1, 1152),
)
_STRIDES = tuple(size.stride for size in _SIZES for _ in range(size.times))


def landmark_shapes() -> LandmarkWeights:
    """Return the shapes of the network's weights."""
    bottlenecks = []
    width = _SIZES[0].wide
    for size in _SIZES:
        for _ in range(size.times):
            widen = None if width == size.wide else linear_shapes(width, size.wide)
            narrow = None if size.out == size.wide else linear_shapes(size.wide, size.out)
            bottlenecks.append(Bottleneck(widen, depthwise_shapes(size.filter, size.wide), narrow))
            width = size.out
    heads = (linear_shapes(width, outputs) for outputs in (1, 1, 63))
    return LandmarkWeights(convolution_shapes(3, 3, 24), tuple(bottlenecks), *heads)


class Landmarks(NamedTuple):
    """What the network says of crops."""

    points: Float[Array, "crop 21 3"]
    """Pixels of the crop (x, y), which spans [0, 224] x [0, 224]; the third number is a relative depth."""
    presence: Float[Array, "crop"]
    """How sure it is that there is a hand."""
    right: Float[Array, "crop"]
    """How sure it is that the hand is a right one."""


def landmark_network(weights: LandmarkWeights, crops: Float[Array, "crop 224 224 3"]) -> Landmarks:
    """Find the key points of the hand in the middle of every crop, RGB in [0, 1], fingers up."""
    x = relu6(convolve(crops, weights.stem, stride=2))
    for bottleneck, stride in zip(weights.bottlenecks, _STRIDES, strict=True):
        x = _bottleneck(x, bottleneck, stride)
    pooled = jnp.mean(x, axis=(1, 2))
    points = linear(pooled, weights.points).reshape(-1, 21, 3)
    presence = nn.sigmoid(linear(pooled, weights.presence))
    right = nn.sigmoid(linear(pooled, weights.handedness))
    return Landmarks(points, presence[:, 0], right[:, 0])


def _bottleneck(x: Array, weights: Bottleneck, stride: int) -> Array:
    y = x if weights.widen is None else relu6(linear(x, weights.widen))
    y = relu6(depthwise(y, weights.filter, stride))
    if weights.narrow is None:
        return y
    y = linear(y, weights.narrow)
    return x + y if y.shape == x.shape else y
