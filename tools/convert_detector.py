"""Make the weights of the hand detector from MediaPipe's wheel.

    pip download --no-deps mediapipe==0.10.14
    python -m tools.convert_detector mediapipe-0.10.14-*.whl

The wheel is a zip; nothing of it is run. Digest of each network, kinds, strides, activations and shapes of
its operators, in their order, are compared with the network as `poem_jax.detection` runs it, before anything
is written.
"""

import hashlib
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

from poem_jax.detection.landmark_network import Bottleneck, LandmarkWeights, landmark_shapes
from poem_jax.detection.layers import Convolution, Depthwise, Linear
from poem_jax.detection.palm_network import Block, Enlarging, PalmWeights, palm_shapes
from poem_jax.detection.stored_weights import LANDMARK_FILE, PALM_FILE, weight_names
from poem_jax.io.atomic import whole_file
from tools.tflite_file import Operator, read_operators

PALM = "mediapipe/modules/palm_detection/palm_detection_full.tflite"
LANDMARK = "mediapipe/modules/hand_landmark/hand_landmark_full.tflite"
SHA256 = {
    PALM: "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
    LANDMARK: "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
}

Weights = PalmWeights | LandmarkWeights


class Reader:
    """Takes the operators of a network one by one, each of the kind that is expected."""

    def __init__(self, operators: Iterator[Operator]) -> None:
        self._operators = operators

    def take(self, kind: str, stride: int = 1, activation: str | None = None) -> tuple[np.ndarray, ...]:
        """Return the constants of the next operator."""
        operator = next(self._operators)
        got = (operator.kind, operator.stride, operator.activation)
        if got != (kind, stride, activation):
            raise SystemExit(f"expected {(kind, stride, activation)}, found {got}")
        return operator.constants

    def skip(self, *kinds: str) -> None:
        """Pass operators without weights."""
        for kind in kinds:
            self.take(kind, stride=2 if kind == "max_pool" else 1)

    def convolution(self, activation: str | None = None) -> Convolution:
        """Return a full convolution of stride 2."""
        kernel, bias = self.take("convolve", 2, activation)
        return Convolution(kernel.transpose(1, 2, 3, 0), bias)

    def linear(self, activation: str | None = None, kind: str = "convolve") -> Linear:
        """Return a 1 x 1 convolution or a dense layer."""
        kernel, bias = self.take(kind, 1, activation)
        return Linear(kernel.reshape(len(kernel), -1).T, bias)

    def filter(self, stride: int, activation: str | None = None) -> Depthwise:
        """Return a depthwise convolution."""
        kernel, bias = self.take("depthwise", stride, activation)
        return Depthwise(kernel[0], bias)

    def slope(self) -> np.ndarray:
        """Return the slopes of a PReLU."""
        (slope,) = self.take("prelu")
        return slope.reshape(-1)

    def end(self) -> None:
        """Check that nothing is left."""
        if (left := next(self._operators, None)) is not None:
            raise SystemExit(f"the network goes on with {left.kind}")


def palm(reader: Reader) -> PalmWeights:
    """Return the weights of the palm network from its operators."""
    stem, stem_slope = reader.convolution(), reader.slope()
    stages, downs = [], []
    for stage in range(5):
        stages.append(stacked([block(reader) for _ in range(4)]))
        if stage < 4:
            downs.append(halving_block(reader, widens=stage < 3))
    return PalmWeights(stem, stem_slope, tuple(stages), tuple(downs), *enlargings(reader))


def block(reader: Reader) -> Block:
    """Return one block that keeps its size."""
    filters, mix = reader.filter(1), reader.linear()
    reader.skip("add")
    return Block(filters, mix, reader.slope())


def halving_block(reader: Reader, widens: bool) -> Block:
    """Return one block that halves the map."""
    filters, mix = reader.filter(2), reader.linear()
    reader.skip("max_pool", *(["pad"] if widens else []), "add")
    return Block(filters, mix, reader.slope())


def enlargings(reader: Reader) -> tuple[Enlarging, Enlarging]:
    """Return what follows the two enlargements."""
    mix, slope, blocks = enlarged_blocks(reader)
    scores = reader.linear()
    reader.skip("reshape")
    boxes = reader.linear()
    reader.skip("reshape")
    coarse = Enlarging(mix, slope, blocks, scores, boxes)
    mix, slope, blocks = enlarged_blocks(reader)
    scores = reader.linear()
    reader.skip("reshape", "concatenate")
    boxes = reader.linear()
    reader.skip("reshape", "concatenate")
    reader.end()
    return coarse, Enlarging(mix, slope, blocks, scores, boxes)


def enlarged_blocks(reader: Reader) -> tuple[Linear, np.ndarray, Block]:
    """Return the mix after an enlargement, its slopes, and the two blocks behind it."""
    reader.skip("resize")
    mix, slope = reader.linear(), reader.slope()
    reader.skip("add")
    return mix, slope, stacked([block(reader) for _ in range(2)])


def stacked(blocks: list[Block]) -> Block:
    """Stack alike blocks along a leading axis."""
    return jax.tree.map(lambda *arrays: np.stack(arrays), *blocks)


def landmark(reader: Reader) -> LandmarkWeights:
    """Return the weights of the landmark network from its operators."""
    stem = reader.convolution("relu6")
    shapes = landmark_shapes().bottlenecks
    bottlenecks, narrow_before = [], 24
    strides = (1, 2, 1, 2, 1, 2, 1, 1, 1, 1, 1, 2, 1, 1, 1, 1)
    for shape, stride in zip(shapes, strides, strict=True):
        widen = reader.linear("relu6") if shape.widen else None
        filters = reader.filter(stride, "relu6")
        narrow = reader.linear() if shape.narrow else None
        width = narrow.bias.size if narrow else None
        if stride == 1 and width == narrow_before and widen:
            reader.skip("add")
        bottlenecks.append(Bottleneck(widen, filters, narrow))
        narrow_before = width
    reader.skip("mean")
    handedness = reader.linear(kind="dense")
    reader.skip("sigmoid")
    presence = reader.linear(kind="dense")
    reader.skip("sigmoid")
    points = reader.linear(kind="dense")
    reader.take("dense")  # points in metres about the hand's middle; they are not used
    reader.end()
    return LandmarkWeights(stem, tuple(bottlenecks), handedness, presence, points)


def convert(data: bytes, build: Callable[[Reader], Weights], shapes: Weights, path: Path) -> None:
    """Write the weights of a network."""
    weights = build(Reader(read_operators(data)))
    for name, got, expected in zip(
        weight_names(weights), jax.tree.leaves(weights), jax.tree.leaves(shapes), strict=True
    ):
        if got.shape != expected.shape:
            raise SystemExit(f"`{name}` must have shape {expected.shape}; found {got.shape}")
        if (got.astype(np.float16) != got).any():
            raise SystemExit(f"`{name}` does not fit into float16")
    arrays = [leaf.astype(np.float16) for leaf in jax.tree.leaves(weights)]
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **dict(zip(weight_names(weights), arrays, strict=True)))


def main(wheel: str) -> None:
    """Convert both networks."""
    with zipfile.ZipFile(wheel) as archive:
        files = {name: archive.read(name) for name in SHA256}
    for name, data in files.items():
        if (digest := hashlib.sha256(data).hexdigest()) != SHA256[name]:
            raise SystemExit(f"{name} of mediapipe 0.10.14 has SHA-256 {SHA256[name]}; got {digest}")
    convert(files[PALM], palm, palm_shapes(), PALM_FILE)
    convert(files[LANDMARK], landmark, landmark_shapes(), LANDMARK_FILE)


if __name__ == "__main__":
    main(*sys.argv[1:])
