"""Read arrays from untrusted `.npz` and `.npy` files: bounded before anything is allocated.

The header of every array is read first: its type must be of plain numbers or text, and its shape must account
for every byte that the file says it holds. Only then is it unpacked, so that a small file which claims 10^12
numbers costs nothing. Nothing in a file is unpickled, and whatever is wrong with one ends in a `ValueError`.
"""

import contextlib
import math
import os
import sys
import zipfile
from collections.abc import Iterator, Sequence
from io import BufferedIOBase
from pathlib import Path
from typing import IO

import numpy as np

from poem_jax.typing import Array

MAX_ARRAY_BYTES = 2**32
"""4 GiB, all arrays of a file together: a take of 8 cameras, 2 hands and 8 hours at 30 frames a second."""
MAX_GROWTH, FREE_BYTES = 100, 2**26
"""Arrays may take 100 times the bytes of their file, and 64 MiB whatever it has: compression makes little of
arrays that are all NaN, but no long take is."""
MAX_ARRAYS = 1000
"""Arrays in a file; ours have up to 30."""
MAX_CAUSE = 300
"""Characters of another library's message that are passed on."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
BinaryStream = IO[bytes] | BufferedIOBase
"""A file, or a member of an archive."""
_KINDS = "biufUS"
"""Truth values, whole numbers, floats and text."""
_ENDING = ".npy"


def read_npz(path: str | os.PathLike, *, required: Sequence[str] = ()) -> dict[str, Array]:
    """Read all arrays of an `.npz` file.

    Args:
        path: The file.
        required: Names that it must hold.

    Returns: Arrays of truth values, whole numbers, floats or text by name, writable, of the machine's
        byte order.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not an npz, damaged or encrypted, a required name is missing (those found are listed), an
            array is of complex numbers, Python objects or records, or the arrays are larger than the bounds
            of this module allow. The message names file, array and cause.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no npz file at {path}")
    with _problems_named(path, "npz of plain arrays"), path.open("rb") as stream:
        if stream.read(6) == np.lib.format.MAGIC_PREFIX:
            raise ValueError("it holds one array without a name (.npy); save it with numpy.savez")
        with zipfile.ZipFile(stream) as archive:
            arrays = _read_members(archive, path.stat().st_size)
    missing = [name for name in required if name not in arrays]
    if missing:
        raise ValueError(f"{path} must hold {_listed(missing)}; found {_listed(list(arrays))}")
    return arrays


def read_npy(path: str | os.PathLike) -> Array:
    """Read the one array of an `.npy` file; errors as in `read_npz`."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no npy file at {path}")
    size = path.stat().st_size
    with _problems_named(path, "npy of plain numbers"), path.open("rb") as stream:
        if size > MAX_ARRAY_BYTES:
            raise ValueError(f"it has {size} bytes, of at most {MAX_ARRAY_BYTES}")
        return _read_array(stream, size)


@contextlib.contextmanager
def _problems_named(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a damaged file makes zipfile, zlib and NumPy's parser raise into one `ValueError`."""
    try:
        yield
    except Exception as error:
        raise ValueError(f"{path} must be an {what}; it cannot be read: {_cause(error)}") from error


def _read_members(archive: zipfile.ZipFile, file_size: int) -> dict[str, Array]:
    members = archive.infolist()
    names = [member.filename.removesuffix(_ENDING) for member in members]
    if len(members) > MAX_ARRAYS or len(set(names)) < len(names):
        raise ValueError(f"it must hold at most {MAX_ARRAYS} arrays of different names")
    foreign = [member.filename for member in members if not member.filename.endswith(_ENDING)]
    if foreign:
        raise ValueError(f"it holds files that are no arrays: {_listed(foreign)}")
    total = sum(member.file_size for member in members)
    limit = min(MAX_ARRAY_BYTES, max(FREE_BYTES, MAX_GROWTH * file_size))
    if total > limit:
        largest = max(members, key=lambda member: member.file_size)
        raise ValueError(
            f"its arrays would take {total} bytes, of at most {limit} for a file of {file_size}; the largest "
            f"is `{largest.filename.removesuffix(_ENDING)[:60]}` with {largest.file_size}"
        )
    arrays = {}
    for name, member in zip(names, members, strict=True):
        with _array_named(name), archive.open(member) as stream:
            arrays[name] = _read_array(stream, member.file_size)
    return arrays


@contextlib.contextmanager
def _array_named(name: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise ValueError(f"`{name[:60]}`: {_cause(error)}") from error


def _read_array(stream: BinaryStream, size: int) -> Array:
    """Read one array in NumPy's format from a stream of `size` bytes."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of NumPy's format is not read")
    shape, fortran_order, dtype = _HEADERS[version](stream)
    if dtype.kind not in _KINDS:
        raise ValueError(f"it must hold plain numbers or text; got {_kind(dtype)}")
    num_bytes = size - stream.tell()
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != num_bytes:
        raise ValueError(f"it claims shape {shape} of {dtype}, but has {num_bytes} bytes")
    data = stream.read(num_bytes)
    # The checksum of a member is compared only where its end is read.
    if len(data) < num_bytes or stream.read(1):
        raise ValueError(f"it is cut short: {len(data)} of {num_bytes} bytes")
    flat = np.frombuffer(data, dtype) if num_bytes else np.empty(math.prod(shape), dtype)
    if dtype.kind == "U" and num_bytes and np.frombuffer(data, f"{dtype.str[0]}u4").max() > sys.maxunicode:
        raise ValueError("its text has characters that do not exist")
    native = flat.astype(dtype.newbyteorder("="), copy=True)
    return native.reshape(shape, order="F" if fortran_order else "C")


def _cause(error: Exception) -> str:
    # Libraries quote what stands in the place of a name or a header, however long.
    if type(error) is ValueError:
        return str(error)[: 2 * MAX_CAUSE]
    shown = str(error)[:MAX_CAUSE]
    return f"{type(error).__name__}: {shown}. Is the file cut short, damaged or of another kind?"


def _kind(dtype: np.dtype) -> str:
    kinds = {"c": "complex numbers", "O": "Python objects", "V": "records", "M": "dates", "m": "durations"}
    return f"{kinds.get(dtype.kind, 'others')} ({dtype})"


def _listed(names: list[str]) -> str:
    shown = [f"`{name[:60]}`" for name in names[:12]]
    return ", ".join(shown + ["..."] * (len(names) > 12)) or "nothing"
