"""What the pickles of a PyTorch file may say, and what each word becomes: descriptions that do nothing.

`torch.save` names tensors, the storages of their numbers and the types of these by globals of torch. Here are
all that may be named, each with an inert stand-in; `safe_pickle` refuses any other.
"""

import io
from collections.abc import Callable
from typing import Any

import ml_dtypes
import numpy as np

from poem_jax.io.pickled_arrays import PickledTensor, TensorStorage
from poem_jax.io.safe_pickle import Inert, Vocabulary, describe_pickle

DTYPES = {
    "HalfStorage": np.dtype(np.float16),
    "FloatStorage": np.dtype(np.float32),
    "DoubleStorage": np.dtype(np.float64),
    "BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
    "CharStorage": np.dtype(np.int8),
    "ShortStorage": np.dtype(np.int16),
    "IntStorage": np.dtype(np.int32),
    "LongStorage": np.dtype(np.int64),
    "ByteStorage": np.dtype(np.uint8),
    "BoolStorage": np.dtype(np.bool_),
}
"""The types of numbers that are read and written, by the name of their storage."""
_UNTYPED = ("UntypedStorage", "_UntypedStorage", "TypedStorage", "_TypedStorage")


class _StorageType(Inert):
    """The type of a storage: it only tells the type of the numbers."""

    __slots__ = ("dtype",)

    def __init__(self, name: str, dtype: np.dtype):
        super().__init__(name)
        self.dtype = dtype


def _make_tensor(
    storage: Any,
    offset: Any,
    size: Any,
    stride: Any,
    requires_grad: Any = False,
    hooks: Any = None,
    pending: Any = None,
) -> PickledTensor:
    """What `torch._utils._rebuild_tensor` and `_v2` take."""
    if pending:
        raise ValueError("a tensor with a pending negation or conjugation is not read")
    return PickledTensor(storage, offset, size, stride)


def _make_parameter(data: Any, *unused: Any) -> PickledTensor:
    """A parameter is its tensor; `unused`: gradient, hooks, attributes."""
    if not isinstance(data, PickledTensor):
        raise ValueError(f"a parameter must be a tensor; got a {type(data).__name__}")
    return data


def _make_size(sizes: Any = ()) -> tuple:
    """Build a `torch.Size`, which is a tuple."""
    if not isinstance(sizes, list | tuple):
        raise ValueError(f"a size must be a tuple; got a {type(sizes).__name__}")
    return tuple(sizes)


def _make_device(*parts: Any) -> tuple:
    """A device, such as ("cuda", 0), tells nothing of the arrays."""
    return parts


_MAKERS = {
    ("torch", "Size"): _make_size,
    ("torch", "device"): _make_device,
    ("torch._utils", "_rebuild_tensor"): _make_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _make_tensor,
    ("torch._utils", "_rebuild_parameter"): _make_parameter,
    ("torch._utils", "_rebuild_parameter_with_state"): _make_parameter,
}
_STORAGE_TYPES = {**DTYPES, **dict.fromkeys(_UNTYPED, np.dtype(np.uint8))}
_NAMES: dict[tuple[str, str], Any] = {
    **{(module, name): Inert(f"{module}.{name}", make) for (module, name), make in _MAKERS.items()},
    **{("torch", str(dtype)): Inert(f"torch.{dtype}") for dtype in DTYPES.values()},
    **{
        (module, name): _StorageType(f"{module}.{name}", dtype)
        for module in ("torch", "torch.storage")
        for name, dtype in _STORAGE_TYPES.items()
    },
}


def describe(stream: io.BytesIO, source: str, persistent: Callable[[Any], Any] | None = None) -> Any:
    """Read one pickle of a torch file, and leave the stream right behind it.

    Args:
        stream: holds the pickle, and perhaps more after it.
        source: names the file in messages.
        persistent: describes an object outside the pickle by its id; None refuses them all.

    Raises:
        ValueError: as for `safe_pickle.describe_pickle`.
    """
    vocabulary = Vocabulary(
        _NAMES,
        # The options of a training run often stand beside its state dict.
        stand_ins=lambda module, name: (module, name) == ("argparse", "Namespace"),
        persistent=persistent,
        advice="Do not trust this file; if it is your own, save `model.state_dict()` alone.",
    )
    return describe_pickle(stream, vocabulary, source)


def make_storage(pid: Any, length: int) -> TensorStorage:
    """Describe the storage with the id ("storage", type, key, location, count, ...) of `length` parts.

    Raises:
        ValueError: the id is not one that torch.save writes.
    """
    if not isinstance(pid, tuple) or len(pid) != length or pid[0] != "storage":
        raise ValueError("an object outside the pickle must be a storage, named as torch.save names it")
    kind, key, _, numel = pid[1:5]
    if not isinstance(kind, _StorageType):
        raise ValueError(f"a storage must have a type of torch's storages; got a {type(kind).__name__}")
    return TensorStorage(key, kind.dtype, numel)
