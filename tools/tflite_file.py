"""Read the networks of a TensorFlow Lite file: operators in order, with their constants; no dependency.

The file is a flatbuffer. A table begins with the distance to its list of field offsets; field i of a table
stands at offset i of that list, or is absent (0); vectors and tables are referred to by a distance.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

_OPERATORS = {
    0: "add",
    2: "concatenate",
    3: "convolve",
    4: "depthwise",
    6: "dequantise",
    9: "dense",
    14: "sigmoid",
    17: "max_pool",
    22: "reshape",
    23: "resize",
    34: "pad",
    40: "mean",
    54: "prelu",
}
_TYPES = {0: np.dtype("<f4"), 1: np.dtype("<f2"), 2: np.dtype("<i4")}
_ACTIVATIONS = {0: None, 1: "relu", 3: "relu6"}


class Operator(NamedTuple):
    """One step of a network."""

    kind: str
    stride: int
    """Of convolutions and pooling, else 1."""
    activation: str | None
    constants: tuple[np.ndarray, ...]
    """Inputs that are stored in the file, in order, 16-bit numbers made 32-bit."""


class Table:
    """A table of a flatbuffer."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self._at = data, at
        self._fields = at - struct.unpack_from("<i", data, at)[0]
        self._size = struct.unpack_from("<H", data, self._fields)[0]

    def number(self, field: int, form: str, default: int = 0) -> int:
        """Return a number stored in the table, by its `struct` letter."""
        at = self._place(field)
        return struct.unpack_from("<" + form, self._data, at)[0] if at else default

    def vector(self, field: int, dtype: np.dtype) -> np.ndarray:
        """Return a vector of numbers, empty where absent."""
        at = self._follow(field)
        if at is None:
            return np.zeros(0, dtype)
        return np.frombuffer(self._data, dtype, struct.unpack_from("<I", self._data, at)[0], at + 4)

    def table(self, field: int) -> "Table | None":
        """Return a table that the field refers to."""
        at = self._follow(field)
        return None if at is None else Table(self._data, at)

    def tables(self, field: int) -> list["Table"]:
        """Return a vector of tables."""
        at = self._follow(field)
        if at is None:
            return []
        places = range(at + 4, at + 4 + 4 * struct.unpack_from("<I", self._data, at)[0], 4)
        return [Table(self._data, place + struct.unpack_from("<I", self._data, place)[0]) for place in places]

    def _place(self, field: int) -> int:
        """Return where a field stands in the file; 0 = absent."""
        entry = 4 + 2 * field
        if entry >= self._size:
            return 0
        offset = struct.unpack_from("<H", self._data, self._fields + entry)[0]
        return self._at + offset if offset else 0

    def _follow(self, field: int) -> int | None:
        at = self._place(field)
        return at + struct.unpack_from("<I", self._data, at)[0] if at else None


def read_operators(data: bytes) -> Iterator[Operator]:
    """Yield the operators of a network, in the order in which they run, those that only unpack left out."""
    model = Table(data, struct.unpack_from("<I", data)[0])
    # The code moved from a byte to an int; files hold the larger of both.
    kinds = [_OPERATORS[max(code.number(0, "b"), code.number(3, "i"))] for code in model.tables(1)]
    (graph,) = model.tables(2)
    tensors, buffers = graph.tables(0), model.tables(4)
    unpacked: dict[int, np.ndarray] = {}
    for table in graph.tables(3):
        kind = kinds[table.number(0, "I")]
        inputs, outputs = (tuple(table.vector(field, np.dtype("<i4")).tolist()) for field in (1, 2))
        stored = {index: _stored(tensors[index], buffers) for index in inputs}
        if kind == "dequantise":
            (packed,) = (array for array in stored.values() if array is not None)
            unpacked[outputs[0]] = packed.astype(np.float32)
            continue
        stored |= {index: unpacked[index] for index in inputs if index in unpacked}
        constants = tuple(array for array in stored.values() if array is not None)
        yield Operator(kind, *_options(kind, table.table(4)), constants)


def _stored(tensor: Table, buffers: list[Table]) -> np.ndarray | None:
    """Return a tensor's constant; None = it is computed."""
    data = buffers[tensor.number(2, "I")].vector(0, np.dtype(np.uint8))
    if not data.size:
        return None
    return data.view(_TYPES[tensor.number(1, "b")]).reshape(tensor.vector(0, np.dtype("<i4")))


def _options(kind: str, options: Table | None) -> tuple[int, str | None]:
    """Return stride and activation of an operator."""
    if options is None or kind not in ("convolve", "depthwise", "max_pool", "add", "dense"):
        return 1, None
    field = {"convolve": 3, "depthwise": 4, "max_pool": 5}.get(kind, 0)
    stride = 1 if kind in ("add", "dense") else options.number(2, "i", 1)
    return stride, _ACTIVATIONS[options.number(field, "b")]
