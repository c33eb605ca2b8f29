"""An npz whose arrays grow on disk and not in memory, and that can be read at any time."""

import contextlib
import shutil
import tempfile
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array

FLUSH_SECONDS = 5.0
"""The file is renewed so often, as long as writing it is quick."""
_MAX_SHARE = 0.05
"""Of the time that may go into writing the file again and again."""


class GrowingNpz:
    """Arrays that get one entry after the other along their first axis.

    Entries are gathered in unnamed files beside the npz, one per array, which vanish with the process.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._files = contextlib.ExitStack()
        self._grown: dict[str, IO[bytes]] = {}
        self._kinds: dict[str, tuple[tuple[int, ...], np.dtype]] = {}
        self._count = 0
        self._due = 0.0

    def append(self, entry: Mapping[str, Array]) -> None:
        """Add an entry: the same names, shapes and types as those before it."""
        for name, values in entry.items():
            if name not in self._grown:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                unnamed = tempfile.TemporaryFile(dir=self.path.parent)  # noqa: SIM115
                self._grown[name] = self._files.enter_context(unnamed)
                self._kinds[name] = values.shape, values.dtype
            assert (values.shape, values.dtype) == self._kinds[name]
            self._grown[name].write(values.tobytes())
        self._count += 1

    def is_due(self) -> bool:
        """Tell whether the file should be written again."""
        return time.monotonic() >= self._due

    def write(self, constant: Mapping[str, Array], without: set[str] | None = None) -> Path:
        """Write the entries so far and arrays that do not grow; the file appears whole or not at all.

        Args:
            constant: Arrays by name.
            without: Names of grown arrays to leave out.
        """
        start = time.monotonic()
        with whole_file(self.path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for name in self._grown.keys() - (without or set()):
                self._copy(name, archive)
            for name, array in constant.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, array)
        now = time.monotonic()
        self._due = now + max(FLUSH_SECONDS, (now - start) / _MAX_SHARE)
        return self.path

    def grown(self, name: str) -> Array:
        """Return the entries so far of an array, (entry, ...), read from the disk as they are used."""
        shape, dtype = self._kinds[name]
        self._grown[name].flush()
        return np.memmap(self._grown[name], dtype, "r", shape=(self._count, *shape))

    def close(self) -> None:
        """Let the gathered entries go; the file stays."""
        self._files.close()

    def _copy(self, name: str, archive: zipfile.ZipFile) -> None:
        shape, dtype = self._kinds[name]
        header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False}
        header["shape"] = (self._count, *shape)
        self._grown[name].seek(0)
        with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(member, header)
            shutil.copyfileobj(self._grown[name], member)
