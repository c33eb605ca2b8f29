"""The palm network (MediaPipe Hands, "palm detection full"): an image in, 2016 guesses of a palm out.

    192 x 192 x 3
      stem, stride 2 -> 96 x 96 x 32
      four blocks, and one that halves the map and widens it, four times: 48 x 64, 24 x 128, 12 x 256, 6 x 256
      four blocks at 6 x 6
      up to 12 x 12, plus the map of that size on the way down, two blocks -> six guesses a cell
      up to 24 x 24, plus the map of that size on the way down, two blocks -> two guesses a cell

A block adds to its input a 5 x 5 filter of every channel followed by a mix of channels, then a PReLU.
"""

from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

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
    prelu,
    slope_shape,
    twice_as_large,
)
from poem_jax.typing import Array, Float

INPUT_SIZE = 192
NUM_GUESSES = 24 * 24 * 2 + 12 * 12 * 6
GUESS_SIZE = 18
"""Centre, width and height of a box, and seven points of the palm."""


class Block(NamedTuple):
    """Filter, mix, PReLU; alike blocks in a row are stacked along a leading axis."""

    filter: Depthwise
    mix: Linear
    slope: Float[Array, "c"]


class Enlarging(NamedTuple):
    """What follows an enlargement: a mix of channels with PReLU, two blocks, two heads."""

    mix: Linear
    slope: Float[Array, "c"]
    blocks: Block
    scores: Linear
    boxes: Linear


class PalmWeights(NamedTuple):
    """Weights of the palm network."""

    stem: Convolution
    stem_slope: Float[Array, "32"]
    stages: tuple[Block, ...]
    """Five times four blocks, stacked."""
    downs: tuple[Block, ...]
    """The four blocks between them that halve the map."""
    coarse: Enlarging
    fine: Enlarging


_WIDTHS = (32, 64, 128, 256, 256)
"""Channels of the stages."""


def palm_shapes() -> PalmWeights:
    """Return the shapes of the network's weights."""

    def block(c_in: int, c_out: int, *stacked: int) -> Block:
        filters = depthwise_shapes(5, c_in, *stacked)
        return Block(filters, linear_shapes(c_in, c_out, *stacked), slope_shape(c_out, *stacked))

    def enlarging(c_in: int, c_out: int, guesses: int) -> Enlarging:
        scores, boxes = linear_shapes(c_out, guesses), linear_shapes(c_out, guesses * GUESS_SIZE)
        mix, slope = linear_shapes(c_in, c_out), slope_shape(c_out)
        return Enlarging(mix, slope, block(c_out, c_out, 2), scores, boxes)

    return PalmWeights(
        stem=convolution_shapes(5, 3, 32),
        stem_slope=slope_shape(32),
        stages=tuple(block(width, width, 4) for width in _WIDTHS),
        downs=tuple(block(*pair) for pair in pairwise(_WIDTHS)),
        coarse=enlarging(256, 256, 6),
        fine=enlarging(256, 128, 2),
    )


def palm_network(
    weights: PalmWeights, images: Float[Array, "image 192 192 3"]
) -> tuple[Float[Array, "image 2016"], Float[Array, "image 2016 18"]]:
    """Guess palms.

    Args:
        weights: Of the network.
        images: RGB in [0, 1].

    Returns: scores before the sigmoid; and boxes with points relative to their anchors, in pixels of the
        input. First 24 x 24 cells with two guesses each, then 12 x 12 with six.
    """
    x = prelu(convolve(images, weights.stem, stride=2), weights.stem_slope)
    on_the_way = []
    for stage, down in zip(weights.stages, (*weights.downs, None), strict=True):
        x = _blocks(x, stage)
        on_the_way.append(x)
        if down is not None:
            x = _halved(x, down)
    coarse, coarse_scores, coarse_boxes = _enlarged(x, on_the_way[3], weights.coarse)
    _, fine_scores, fine_boxes = _enlarged(coarse, on_the_way[2], weights.fine)
    scores = jnp.concatenate([fine_scores, coarse_scores], axis=1)
    return scores[..., 0], jnp.concatenate([fine_boxes, coarse_boxes], axis=1)


def _blocks(x: Array, stacked: Block) -> Array:
    """Run alike blocks one after the other, compiled once."""
    return lax.scan(lambda x, block: (_block(x, block), None), x, stacked)[0]


def _block(x: Array, block: Block) -> Array:
    return prelu(x + linear(depthwise(x, block.filter, stride=1), block.mix), block.slope)


def _halved(x: Array, block: Block) -> Array:
    """Halve the map; what bypasses the filter is the largest of each 2 x 2, new channels begin at zero."""
    largest = lax.reduce_window(x, -jnp.inf, lax.max, (1, 2, 2, 1), (1, 2, 2, 1), "VALID")
    mixed = linear(depthwise(x, block.filter, stride=2), block.mix)
    more = mixed.shape[-1] - largest.shape[-1]
    return prelu(jnp.pad(largest, ((0, 0), (0, 0), (0, 0), (0, more))) + mixed, block.slope)


def _enlarged(x: Array, beside: Array, weights: Enlarging) -> tuple[Array, Array, Array]:
    x = prelu(linear(twice_as_large(x), weights.mix), weights.slope)
    x = _blocks(beside + x, weights.blocks)
    scores, boxes = linear(x, weights.scores), linear(x, weights.boxes)
    return x, scores.reshape(len(x), -1, 1), boxes.reshape(len(x), -1, GUESS_SIZE)
