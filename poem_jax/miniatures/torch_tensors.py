"""Write pickles that hold PyTorch tensors, without PyTorch.

`pickle.dump` of a dictionary of tensors names `torch._utils._rebuild_tensor_v2` and, for the numbers,
`torch.storage._load_from_bytes` with a whole little file in the form that `torch.save` wrote before
version 1.6. Here stand-ins are pickled, and their names then replaced by those of torch, so that
`pickle.load` gives tensors where torch is installed.
"""

import io
import pickle
import struct
from collections import OrderedDict
from typing import Any

import numpy as np

from poem_jax.typing import Array, Float

_MAGIC = 0x1950A86A20F9469CFC6C
_VERSION = 1001
_SYSTEM = {
    "protocol_version": _VERSION,
    "little_endian": True,
    "type_sizes": {"short": 2, "int": 4, "long": 4},
}
_KEY = "94382711"
"""Torch names a storage after its address."""


class Tensor:
    """Is pickled as a `torch.FloatTensor` of these numbers."""

    def __init__(self, numbers: Float[Array, "..."]) -> None:
        self.numbers = np.ascontiguousarray(numbers, "<f4")

    def __reduce__(self) -> tuple:
        strides = tuple(step // self.numbers.itemsize for step in self.numbers.strides)
        storage = _Storage(self.numbers)
        return _rebuild_tensor_v2, (storage, 0, self.numbers.shape, strides, False, OrderedDict())


def dumps(value: Any) -> bytes:
    """Pickle plain containers that hold `Tensor`s, arrays, numbers and strings."""
    stream = io.BytesIO()
    _Pickler(stream, protocol=2).dump(value)
    return _under_torch_names(stream.getvalue())


class _Storage:
    def __init__(self, numbers: Array) -> None:
        self.numbers = numbers

    def __reduce__(self) -> tuple:
        return _load_from_bytes, (_saved_storage(self.numbers),)


class _Pickler(pickle.Pickler):
    def persistent_id(self, obj: Any) -> tuple | None:
        """Storages of a saved file are named, and their numbers follow the pickle."""
        if not isinstance(obj, _Named):
            return None
        return ("storage", FloatStorage, _KEY, "cpu", obj.size, None)


class _Named:
    def __init__(self, size: int) -> None:
        self.size = size


def _saved_storage(numbers: Array) -> bytes:
    """Return what `torch.save(storage)` writes in its old form."""
    head = [pickle.dumps(part, protocol=2) for part in (_MAGIC, _VERSION, _SYSTEM)]
    keys = pickle.dumps([_KEY], protocol=2)
    size = struct.pack("<q", numbers.size)
    return b"".join([*head, dumps(_Named(numbers.size)), keys, size, numbers.tobytes()])


def _under_torch_names(pickled: bytes) -> bytes:
    """Rename the stand-ins; protocol 2 writes names as lines of text, of any length."""
    for stand_in, module in _MODULES.items():
        name = stand_in.__name__
        pickled = pickled.replace(f"c{__name__}\n{name}\n".encode(), f"c{module}\n{name}\n".encode())
    return pickled


class FloatStorage:
    """Stands for torch's; only its name is used."""


def _rebuild_tensor_v2(*arguments: Any) -> None:
    """Stands for torch's; only its name is used."""


def _load_from_bytes(*arguments: Any) -> None:
    """Stands for torch's; only its name is used."""


_MODULES = {FloatStorage: "torch", _rebuild_tensor_v2: "torch._utils", _load_from_bytes: "torch.storage"}
