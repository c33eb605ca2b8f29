"""The tool that makes the detector's weights: it reads TensorFlow Lite files, and refuses other networks."""

import struct
import zipfile

import jax
import numpy as np
import pytest

from poem_jax.detection.palm_network import palm_shapes
from tools.convert_detector import LANDMARK, PALM, Reader, convert, main, palm
from tools.tflite_file import Operator, read_operators

KERNEL = np.arange(24, dtype=np.float16).reshape(2, 2, 2, 3)
BIAS = np.array([0.5, -1], np.float32)


def flatbuffer(root):
    """Write a table: {field: (letter, number) | bytes of a vector and its length | table | tables}."""
    data = bytearray(4)
    struct.pack_into("<I", data, 0, _append(data, root))
    return bytes(data)


def _append(data, fields):
    size = 4 + 2 * (max(fields, default=-1) + 1)
    listed, at = len(data), len(data) + size
    data += bytes(size + 4 + 4 * len(fields))
    struct.pack_into("<HH", data, listed, size, 4 + 4 * len(fields))
    struct.pack_into("<i", data, at, at - listed)
    for slot, (field, value) in enumerate(fields.items()):
        place = at + 4 + 4 * slot
        struct.pack_into("<H", data, listed + 4 + 2 * field, place - at)
        if isinstance(value, tuple) and isinstance(value[0], str):
            struct.pack_into("<" + value[0], data, place, value[1])
            continue
        struct.pack_into("<I", data, place, len(data) - place)
        if isinstance(value, dict):
            # The table stands behind its list of fields.
            target = _append(data, value)
            struct.pack_into("<I", data, place, target - place)
        elif isinstance(value, list):
            vector = len(data)
            data += struct.pack("<I", len(value)) + bytes(4 * len(value))
            for number, table in enumerate(value):
                entry = vector + 4 + 4 * number
                struct.pack_into("<I", data, entry, _append(data, table) - entry)
        else:
            content, count = value
            data += struct.pack("<I", count) + content
    return at


def vector(numbers, dtype):
    array = np.asarray(numbers, dtype)
    return array.tobytes(), array.size


def network():
    """A kernel of 16 bits is unpacked, then a convolution of stride 2 with ReLU6 uses it, then slopes."""

    def tensor(shape, kind, buffer):
        return {0: vector(shape, "<i4"), 1: ("b", kind), 2: ("I", buffer)}

    def operator(code, inputs, outputs, **options):
        return {
            0: ("I", code),
            1: vector(inputs, "<i4"),
            2: vector(outputs, "<i4"),
            **options.get("table", {}),
        }

    buffers = [{}, *({0: vector(array.view(np.uint8), np.uint8)} for array in (KERNEL.ravel(), BIAS, BIAS))]
    tensors = [
        tensor((1, 4, 4, 3), 0, 0),
        tensor(KERNEL.shape, 1, 1),
        tensor(KERNEL.shape, 0, 0),
        tensor((2,), 0, 2),
        tensor((1, 2, 2, 2), 0, 0),
        tensor((2,), 0, 3),
    ]
    # Codes of operators in the old field of one byte, or in the new one.
    codes = [{0: ("b", 6)}, {0: ("b", 3), 3: ("i", 3)}, {3: ("i", 54)}]
    operators = [
        operator(0, [1], [2]),
        operator(1, [0, 2, 3], [4], table={4: {1: ("i", 2), 2: ("i", 2), 3: ("b", 3)}}),
        operator(2, [4, 5], [4]),
    ]
    return flatbuffer({1: codes, 2: [{0: tensors, 3: operators}], 4: buffers})


def test_a_file_is_read_operator_by_operator():
    convolution, slopes = read_operators(network())
    assert (convolution.kind, convolution.stride, convolution.activation) == ("convolve", 2, "relu6")
    kernel, bias = convolution.constants
    assert kernel.dtype == np.float32
    np.testing.assert_array_equal(kernel, KERNEL)
    np.testing.assert_array_equal(bias, BIAS)
    assert (slopes.kind, slopes.stride, slopes.activation) == ("prelu", 1, None)
    np.testing.assert_array_equal(slopes.constants[0], BIAS)


def test_weights_are_laid_out_as_the_networks_take_them():
    reader = Reader(read_operators(network()))
    convolution = reader.convolution("relu6")
    np.testing.assert_array_equal(convolution.kernel, KERNEL.transpose(1, 2, 3, 0))
    np.testing.assert_array_equal(reader.slope(), BIAS)
    reader.end()


def test_another_network_is_refused(tmp_path):
    with pytest.raises(
        SystemExit, match=r"expected \('convolve', 2, None\), found \('convolve', 2, 'relu6'\)"
    ):
        convert(network(), palm, palm_shapes(), tmp_path / "palm.npz")
    reader = Reader(iter([Operator("add", 1, None, ())]))
    with pytest.raises(SystemExit, match="the network goes on with add"):
        reader.end()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("slope", "message"),
    [
        (np.ones(3), r"`stem_slope` must have shape \(32,\); found \(3,\)"),
        (np.full(32, 1 / 3), "into float16"),
    ],
)
def test_weights_that_would_be_spoiled_are_refused(tmp_path, slope, message):
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, np.float32), palm_shapes())
    spoiled = zeros._replace(stem_slope=slope.astype(np.float32))
    with pytest.raises(SystemExit, match=message):
        convert(network(), lambda _: spoiled, palm_shapes(), tmp_path / "palm.npz")
    assert not list(tmp_path.iterdir())
    convert(network(), lambda _: zeros, palm_shapes(), tmp_path / "palm.npz")
    assert (tmp_path / "palm.npz").exists()


def test_another_wheel_is_refused(tmp_path):
    wheel = tmp_path / "mediapipe.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr(PALM, network())
        archive.writestr(LANDMARK, network())
    with pytest.raises(SystemExit, match=r"palm_detection_full.tflite of mediapipe 0\.10\.14 has SHA-256"):
        main(str(wheel))
