"""Single rows of a large array in an `.npz`, read from where they lie: a long take need not be in memory."""

import functools
import os
import struct
import zipfile
from pathlib import Path

import numpy as np

from poem_jax.io.npz_file import read_npz
from poem_jax.typing import Array

_LOCAL_HEADER = struct.Struct("<26xHH")
"""Of a member of a zip archive: the lengths of its name and of its extra field stand last."""


class NpzRows:
    """Rows, along the first axis, of one array of an npz. Opens the file at every use; can be pickled."""

    def __init__(self, path: str | os.PathLike, name: str) -> None:
        """Find the array.

        Raises:
            FileNotFoundError, ValueError: As `read_npz`, which reads the file whole once, and so checks it.
        """
        self.path, self.name = Path(path), name
        array = read_npz(self.path, required=[name])[name]
        self.shape = array.shape
        self._row = np.dtype((array.dtype, array.shape[1:]))
        self._size = self.path.stat().st_size
        self._start = _start_of(self.path, name, array)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int) -> Array:
        """Return one row.

        Raises:
            OSError, ValueError: The file is gone, or has changed since it was opened.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"`{self.name}` in {self.path} has {len(self)} rows; got {index}")
        if self._start is None:
            return _whole(self.path, self.name)[index].copy()
        with self.path.open("rb") as stream:
            if os.fstat(stream.fileno()).st_size != self._size:
                raise ValueError(f"{self.path} has changed since it was opened")
            stream.seek(self._start + index * self._row.itemsize)
            data = stream.read(self._row.itemsize)
        return np.frombuffer(data, self._row.base).reshape(self.shape[1:]).copy()


def _start_of(path: Path, name: str, array: Array) -> int | None:
    """Return where the numbers begin in the file; None where they do not lie there row by row."""
    with zipfile.ZipFile(path) as archive, path.open("rb") as stream:
        member = archive.getinfo(f"{name}.npy")
        if member.compress_type != zipfile.ZIP_STORED:
            return None
        stream.seek(member.header_offset)
        begin = member.header_offset + _LOCAL_HEADER.size + sum(_LOCAL_HEADER.unpack(stream.read(30)))
        start = begin + member.file_size - array.nbytes
        # A copy in another order of bytes or axes does not start with the same row.
        stream.seek(start)
        first = array[:1].tobytes()
        return start if stream.read(len(first)) == first else None


@functools.lru_cache(maxsize=2)
def _whole(path: Path, name: str) -> Array:
    return read_npz(path, required=[name])[name]
