"""What a pickle says of arrays and tensors, kept inert and checked before NumPy sees any of it.

`np.dtype` and `np.ndarray` trust the state that a pickle gives them: a forged one makes NumPy read bytes as
pointers. The classes here take the same calls, accept only the few forms that NumPy writes for plain numbers,
and make the array from bytes whose count was checked. Tensors of PyTorch are views of storages, which lie
outside the pickle; a view is checked against its storage before any number is read.
"""

import math
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided

_CODES = ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
_OBJECT_CODES = ("O8", "O4")
_ORDERS = ("<", ">", "|")
_MAX_DIMENSIONS = 32
_LARGEST_BYTES = 2**40


def refuse_change(name: str) -> None:
    """Answer a pickle that wants to set the state of something fixed.

    Raises:
        ValueError: always.
    """
    raise ValueError(f"{name} may not be changed")


class PickledDtype:
    """A type of plain numbers: a code such as "f8", and a byte order set once."""

    __slots__ = ("_code", "_order")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, code: Any, align: Any = False, copy: Any = True):
        """Take the arguments that `numpy.dtype` gives to its own pickles.

        Raises:
            ValueError: a code of anything but plain numbers.
        """
        if _latin1(code) not in _CODES or not all(type(flag) in (bool, int) for flag in (align, copy)):
            raise ValueError(
                f"dtype {_shown(code)} is refused: only plain numbers ({', '.join(_CODES)}) are read, "
                "no arrays of Python objects, text or records"
            )
        self._code, self._order = _latin1(code), None

    def __setstate__(self, state: Any) -> None:
        """Take (3, order, None, None, None, -1, -1, 0), as NumPy writes it for numbers, and nothing else."""
        if self._order is not None:
            refuse_change("a finished dtype")
        plain = isinstance(state, tuple) and len(state) == 8
        if not plain or _latin1(state[1]) not in _ORDERS or not _is_plain_state(state):
            raise ValueError(f"the state of dtype {self._code!r} is not one that NumPy writes for numbers")
        self._order = _latin1(state[1])

    def numpy(self) -> np.dtype:
        """Make the true dtype."""
        return np.dtype(self._code).newbyteorder(self._order or "=")


class ObjectDtype:
    """The type of Python objects, read for one purpose: rows of lists of numbers (SciPy's LIL matrices)."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        """Take (3, "|", None, None, None, -1, -1, flags), as NumPy writes it."""
        whole = isinstance(state, tuple) and len(state) == 8 and _latin1(state[1]) == "|"
        if not whole or not _is_plain_state((*state[:7], 0)):
            raise ValueError("the state of a dtype of objects is not one that NumPy writes")


def describe_dtype(code: Any, *flags: Any) -> PickledDtype | ObjectDtype:
    """Describe a dtype by the arguments that `numpy.dtype` gives to its own pickles."""
    return ObjectDtype() if _latin1(code) in _OBJECT_CODES else PickledDtype(code, *flags)


class PickledArray:
    """An array or scalar that a pickle describes: first empty, then filled once."""

    __slots__ = ("_dtype", "_order", "_raw", "_rows", "_scalar", "_shape")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self) -> None:
        """Start empty: `fill` or `__setstate__` follows."""
        self._raw: bytes | None = None
        self._rows: list | None = None

    def fill(self, shape: Any, dtype: Any, order: str, data: Any, scalar: bool = False) -> "PickledArray":
        """Take the contents; return self.

        Raises:
            ValueError: already filled; not plain numbers; a shape or a byte count that do not fit.
        """
        self._refuse_second_contents()
        if not isinstance(dtype, PickledDtype):
            raise ValueError(f"an array's type must be a dtype of numbers; got a {type(dtype).__name__}")
        if isinstance(data, str):
            data = data.encode("latin1")
        if not isinstance(data, bytes):
            raise ValueError(f"an array must come as bytes, not as a {type(data).__name__}")
        self._dtype, self._order, self._scalar = dtype.numpy(), order, scalar
        self._shape = _checked_shape(shape, self._dtype.itemsize, len(data))
        self._raw = data
        return self

    def __setstate__(self, state: Any) -> None:
        """Take (version, shape, dtype, Fortran order, bytes), or the same without version."""
        if not isinstance(state, tuple) or len(state) not in (4, 5) or state[:-4] not in ((), (1,)):
            raise ValueError("the state of an array is not one that NumPy writes")
        shape, dtype, is_fortran, data = state[-4:]
        if type(is_fortran) not in (bool, int):
            raise ValueError("the state of an array is not one that NumPy writes")
        if isinstance(dtype, ObjectDtype):
            self._fill_with_rows(shape, data)
        else:
            self.fill(shape, dtype, "F" if is_fortran else "C", data)

    def _fill_with_rows(self, shape: Any, rows: Any) -> None:
        self._refuse_second_contents()
        whole = isinstance(rows, list) and shape == (len(rows),) and all(isinstance(r, list) for r in rows)
        if not whole:
            raise ValueError("dtype 'O8' is refused: of arrays of Python objects only rows of lists are read")
        self._rows = rows

    def _refuse_second_contents(self) -> None:
        if self._raw is not None or self._rows is not None:
            refuse_change("a finished array")

    @property
    def nbytes(self) -> int:
        """Size of the contents; 0 before they are given."""
        return len(self._raw or b"")

    def array(self) -> Any:
        """Make the true array (a copy, writable) or scalar, or of rows of lists these lists, unchecked.

        Raises:
            ValueError: the pickle never gave its contents.
        """
        if self._rows is not None:
            return self._rows
        if self._raw is None:
            raise ValueError("an array was announced but never given")
        flat = np.frombuffer(self._raw, dtype=self._dtype)
        if self._scalar:
            return flat[0]
        return flat.reshape(self._shape, order=self._order).copy(order="K")  # type: ignore[call-overload]


class PickledArrayOrDict(PickledArray):
    """An array of numbers or, without axes, of one dict, which `array` gives as [dict]."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        """Take what `PickledArray` takes, or (1, (), objects, Fortran order, [dict])."""
        whole = isinstance(state, tuple) and len(state) == 5 and isinstance(state[2], ObjectDtype)
        if not whole or state[1] != () or not _is_one_dict(state[4]):
            super().__setstate__(state)
            return
        self._refuse_second_contents()
        self._rows = state[4]


class TensorStorage:
    """A row of `numel` numbers, from number `start` of the run that the file keeps under `key`."""

    __slots__ = ("dtype", "key", "numel", "start")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, key: Any, dtype: np.dtype, numel: Any, start: Any = 0):
        """Take what a pickle says.

        Raises:
            ValueError: a key that is no text, or counts that are no counts.
        """
        if not isinstance(key, str):
            raise ValueError(f"a storage's key must be text; got a {type(key).__name__}")
        if not _is_sizes((numel, start)):
            raise ValueError(f"storage {_shown(key)} must have a count of numbers, at most {_LARGEST_BYTES}")
        self.key, self.dtype, self.numel, self.start = key, dtype, numel, start

    def __setstate__(self, state: Any) -> None:
        refuse_change("a storage")

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return self.numel * self.dtype.itemsize

    def part(self, start: Any, numel: Any) -> "TensorStorage":
        """Describe the numbers from `start` on.

        Raises:
            ValueError: the part is not within this storage.
        """
        part = TensorStorage(self.key, self.dtype, numel, start)
        if start + numel > self.numel:
            raise ValueError(f"{numel} numbers from {start} on leave a storage of {self.numel}")
        return part


class PickledTensor:
    """A view of a storage: `shape`, and by how many numbers each axis steps."""

    __slots__ = ("_offset", "_strides", "shape", "storage")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, storage: Any, offset: Any, shape: Any, strides: Any):
        """Take what a pickle says.

        Raises:
            ValueError: no storage, no sizes, or a view that leaves its storage.
        """
        if not isinstance(storage, TensorStorage):
            raise ValueError(f"a tensor must look at a storage; got a {type(storage).__name__}")
        self.shape = _checked_sizes(shape, storage.dtype.itemsize)
        if not _is_sizes(strides) or len(strides) != len(self.shape) or not _is_sizes((offset,)):
            raise ValueError("a tensor must have an offset and one stride for each axis, none negative")
        steps = sum((n - 1) * stride for n, stride in zip(self.shape, strides, strict=True))
        # Without elements nothing is read, wherever the view may lie.
        end = offset + steps + 1 if math.prod(self.shape) else 0
        if end > storage.numel:
            raise ValueError(
                f"a tensor of shape {self.shape}, strides {strides} and offset {offset} reaches number {end} "
                f"of a storage of {storage.numel}"
            )
        self.storage, self._offset, self._strides = storage, offset, strides

    def __setstate__(self, state: Any) -> None:
        refuse_change("a finished tensor")

    @property
    def nbytes(self) -> int:
        """Size of the array in bytes, larger than its part of the storage where a stride is 0."""
        return math.prod(self.shape) * self.storage.dtype.itemsize

    def array(self, numbers: np.ndarray) -> np.ndarray:
        """Make the true array: a copy, in C order, writable.

        Args:
            numbers: all that the file keeps under the storage's key, shape (n,).
        """
        if not self.nbytes:
            return np.empty(self.shape, numbers.dtype)
        strides = tuple(stride * numbers.itemsize for stride in self._strides)
        first = self.storage.start + self._offset
        return as_strided(numbers[first:], self.shape, strides).copy(order="C")


def _is_one_dict(rows: Any) -> bool:
    return isinstance(rows, list) and len(rows) == 1 and isinstance(rows[0], dict)


def _is_plain_state(state: tuple) -> bool:
    expected = (3, None, None, None, -1, -1, 0)
    got = (state[0], *state[2:])
    return all(type(a) is type(b) and a == b for a, b in zip(got, expected, strict=True))


def _is_sizes(sizes: Any) -> bool:
    whole = isinstance(sizes, tuple) and len(sizes) <= _MAX_DIMENSIONS
    return whole and all(type(n) is int and 0 <= n <= _LARGEST_BYTES for n in sizes)


def _checked_sizes(shape: Any, itemsize: int) -> tuple[int, ...]:
    if not _is_sizes(shape):
        raise ValueError("an array's shape must be a tuple of sizes, none beyond a file's")
    if math.prod(max(n, 1) for n in shape) * itemsize > _LARGEST_BYTES:
        raise ValueError("an array's shape is beyond any file's size")
    return shape


def _checked_shape(shape: Any, itemsize: int, num_bytes: int) -> tuple[int, ...]:
    expected = math.prod(_checked_sizes(shape, itemsize)) * itemsize
    if expected != num_bytes:
        raise ValueError(f"an array of shape {shape} needs {expected} bytes; got {num_bytes}")
    return shape


def _latin1(text: Any) -> Any:
    return text.decode("latin1") if isinstance(text, bytes) else text if isinstance(text, str) else None


def _shown(value: Any) -> str:
    """Show text in short; of anything else only its type, for its contents may be endless."""
    return repr(value[:20]) if isinstance(value, str | bytes) else f"of a {type(value).__name__}"
