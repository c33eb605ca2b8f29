"""Single arrays out of label files (`.npz`) that also hold large ones nobody needs here, such as masks."""

import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from poem_jax.io.npz_file import BinaryStream
from poem_jax.typing import Array

_MAX_HEADER = 4096
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_FAULTS = (OSError, ValueError, KeyError, EOFError, NotImplementedError, RuntimeError)
"""What zipfile and NumPy's parser raise for damaged, encrypted or foreign files."""


def read_label_arrays(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Read floating-point arrays of known shapes; the other members are not unpacked.

    Args:
        path: The file.
        shapes: Of each array that is wanted, by its name.

    Raises:
        ValueError: The file is missing or damaged, lacks an array, or has one of another shape or type.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {name: _read_member(archive, name, shape) for name, shape in shapes.items()}
    except (*_FAULTS, zipfile.BadZipFile, zlib.error) as error:
        cause = f"{type(error).__name__}: {error}"[:300]
        raise ValueError(
            f"{path} must hold the arrays {', '.join(shapes)}; reading stopped: {cause}"
        ) from error


def _read_member(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...]) -> Array:
    with archive.open(f"{name}.npy") as stream:
        found, fortran_order, dtype = _read_header(stream)
        if found != shape or dtype.kind != "f":
            raise ValueError(f"`{name}` must be floating-point numbers {shape}; got {dtype} {found}")
        size = math.prod(shape) * dtype.itemsize
        data = stream.read(size + _MAX_HEADER)
    if len(data) != size:
        raise ValueError(f"`{name}` must have {size} bytes; got {len(data)}")
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran_order else "C")
    return array.astype(dtype.newbyteorder("="))


def _read_header(stream: BinaryStream) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of NumPy's format is not read")
    return _HEADERS[version](stream, max_header_size=_MAX_HEADER)
