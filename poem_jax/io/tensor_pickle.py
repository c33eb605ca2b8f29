"""Read pickles that hold PyTorch's tensors, without PyTorch: those of `pickle.dump`, not of `torch.save`.

A tensor in such a pickle is a call of `torch._utils._rebuild_tensor_v2` on a storage, and the storage a call
of `torch.storage._load_from_bytes` on the bytes of a whole file of `torch.save` in its old form (see
`torch_file.py`), which holds that one storage. Both calls become descriptions of arrays here, checked by the
same rules; any other global that is no array's is refused.
"""

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.io.pickled_arrays import PickledArray, PickledDtype, PickledTensor, TensorStorage
from poem_jax.io.safe_pickle import Inert, Vocabulary, describe_pickle
from poem_jax.io.torch_pickle import describe, make_storage

_PICKLES_BEFORE = 3
"""Before the storage's: torch's magic number, the protocol, facts of the machine."""
_DEEPEST = 20
_PLAIN = (str, bytes, int, float, bool, type(None))


def load_tensors_pickle(path: str | Path) -> Any:
    """Read a pickle of plain containers, NumPy arrays and tensors; tensors become arrays.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no whole pickle, asks for a global outside the allow-list, or describes arrays or
            tensors that do not fit their bytes. The message names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}; give the path of a pickle of arrays or tensors")
    described = describe_pickle(io.BytesIO(path.read_bytes()), Vocabulary(_NAMES), str(path))
    try:
        return _finished(described, 0)
    except ValueError as error:
        raise ValueError(f"{path} must hold arrays in plain containers: {error}") from error


class _Storage(NamedTuple):
    described: TensorStorage
    numbers: np.ndarray


def _load_storage(data: Any) -> _Storage:
    """Read the storage from the bytes of a file in torch's old form."""
    if not isinstance(data, bytes):
        raise ValueError(f"a storage must come as bytes; got a {type(data).__name__}")
    source, stream = "a tensor's storage", io.BytesIO(data)
    for _ in range(_PICKLES_BEFORE):
        describe(stream, source)
    storage = describe(stream, source, lambda pid: make_storage(pid, length=6))
    if not isinstance(storage, TensorStorage):
        raise ValueError(f"a storage was expected; got a {type(storage).__name__}")
    if describe(stream, source) != [storage.key]:
        raise ValueError("the bytes of a storage must hold that one storage")
    start = stream.tell() + 8
    if int.from_bytes(data[start - 8 : start], "little") != storage.numel:
        raise ValueError(f"a storage must have its {storage.numel} numbers")
    raw = data[start : start + storage.nbytes]
    if len(raw) != storage.nbytes:
        raise ValueError(f"a storage must have {storage.nbytes} bytes; got {len(raw)}")
    return _Storage(storage, np.frombuffer(raw, storage.dtype.newbyteorder("<")))


def _make_tensor(storage: Any, offset: Any, size: Any, stride: Any, *unused: Any) -> PickledArray:
    """What `torch._utils._rebuild_tensor_v2` takes; `unused`: gradient, hooks."""
    if not isinstance(storage, _Storage):
        raise ValueError(f"a tensor must look at a storage; got a {type(storage).__name__}")
    tensor = PickledTensor(storage.described, offset, size, stride)
    if tensor.nbytes > 16 * max(storage.described.nbytes, 1):
        raise ValueError("a tensor is far larger than its storage")
    array = tensor.array(storage.numbers)
    dtype = PickledDtype(f"{array.dtype.kind}{array.dtype.itemsize}")
    return PickledArray().fill(array.shape, dtype, "C", array.astype(array.dtype.newbyteorder("=")).tobytes())


def _make_size(sizes: Any = ()) -> tuple:
    if not isinstance(sizes, list | tuple):
        raise ValueError(f"a size must be a tuple; got a {type(sizes).__name__}")
    return tuple(sizes)


_NAMES = {
    ("torch._utils", "_rebuild_tensor"): Inert("torch._utils._rebuild_tensor", _make_tensor),
    ("torch._utils", "_rebuild_tensor_v2"): Inert("torch._utils._rebuild_tensor_v2", _make_tensor),
    ("torch.storage", "_load_from_bytes"): Inert("torch.storage._load_from_bytes", _load_storage),
    ("torch", "Size"): Inert("torch.Size", _make_size),
}


def _finished(value: Any, depth: int) -> Any:
    """Put arrays in the place of their descriptions."""
    if depth > _DEEPEST:
        raise ValueError(f"containers nest more than {_DEEPEST} deep")
    if isinstance(value, PickledArray):
        return value.array()
    if isinstance(value, dict):
        return {key: _finished(entry, depth + 1) for key, entry in value.items()}
    if isinstance(value, list | tuple) and not isinstance(value, _Storage):
        return type(value)([_finished(entry, depth + 1) for entry in value])
    if not isinstance(value, _PLAIN):
        raise ValueError(f"a {type(value).__name__} is no data")
    return value
