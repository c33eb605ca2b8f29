"""A folder as files of at most 16 MiB that can be carried away one by one, and back into a folder.

`pack` writes 000.part, 001.part, ... and parts.json with size and SHA-256 of each, and how far the run in the
folder is. Parts that stand there go only when the new ones are complete.
"""

import hashlib
import io
import json
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from poem_jax.io.json_file import read_json

PART_BYTES = 16 * 2**20
LISTING = "parts.json"


def pack(folder: Path, into: Path, *, step: int, limit: int = PART_BYTES) -> list[Path]:
    """Write a folder as parts to the folder `into`, in the place of the parts that may stand there.

    Args:
        folder: what is packed, a run.
        into: where the parts are to be.
        step: of the newest checkpoint, for `step_of`.
        limit: bytes of a part at most.

    Returns: the files written, the list of parts last.
    """
    fresh, old = (into.with_name(f".{into.name}.{name}") for name in ("new", "old"))
    for leftover in (fresh, old):
        shutil.rmtree(leftover, ignore_errors=True)
    fresh.mkdir(parents=True)
    writer = _Parts(fresh, limit)
    with writer, tarfile.open(fileobj=writer, mode="w|") as tar:  # pyright: ignore[reportArgumentType, reportCallIssue]
        tar.add(folder, arcname=".")
    listing = json.dumps({"step": step, "parts": writer.written}, indent=1) + "\n"
    (fresh / LISTING).write_text(listing, encoding="utf-8")
    if into.exists():
        into.rename(old)
    fresh.rename(into)
    shutil.rmtree(old, ignore_errors=True)
    return [*(into / part["file"] for part in writer.written), into / LISTING]


def unpack(parts: Path, folder: Path) -> None:
    """Write what `pack` was given to `folder`, which must not exist; there it is whole, or not at all.

    Raises:
        FileExistsError: the folder exists.
        ValueError: a part is missing or damaged, or the list is none; names the file.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists; parts are unpacked to a new folder. Move it away")
    files = _checked(parts)
    half = folder.with_name(f".{folder.name}.half")
    shutil.rmtree(half, ignore_errors=True)
    with tarfile.open(fileobj=io.BufferedReader(_Joined(files)), mode="r|") as tar:
        tar.extractall(half, filter="data")
    half.rename(folder)


def step_of(parts: Path) -> int:
    """Return how far the run is that was packed.

    Raises: ValueError: the list of parts is none.
    """
    return _listed(parts)[0]


def _listed(parts: Path) -> tuple[int, list[tuple[str, int, str]]]:
    """Read the step, and the name, size and SHA-256 of every part."""
    listing = parts / LISTING
    try:
        content = read_json(listing, what="list of parts")
        entries = [(str(e["file"]), int(e["bytes"]), str(e["sha256"])) for e in content["parts"]]
        return int(content["step"]), entries
    except (KeyError, TypeError, FileNotFoundError) as error:
        raise ValueError(f"{listing} is not a list of parts: {type(error).__name__} {error}") from error


def _checked(parts: Path) -> list[Path]:
    _, expected = _listed(parts)
    files = [parts / Path(name).name for name, _, _ in expected]
    for file, (_, size, digest) in zip(files, expected, strict=True):
        if not file.is_file():
            raise ValueError(f"{file} is missing, one of the {len(files)} that {LISTING} names. Copy it, too")
        if file.stat().st_size != size or hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            raise ValueError(f"{file} is damaged: it is not what {LISTING} says. Copy it again")
    return files


class _Parts:
    """A stream that goes to a new file after every `limit` bytes."""

    def __init__(self, into: Path, limit: int) -> None:
        self._into, self._limit = into, limit
        self._buffer = bytearray()
        self.written: list[dict[str, Any]] = []

    def __enter__(self) -> "_Parts":
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is None and self._buffer:
            self._write(bytes(self._buffer))

    def write(self, data: bytes) -> int:
        """Take bytes, as a tar file gives them."""
        self._buffer += data
        while len(self._buffer) >= self._limit:
            self._write(bytes(self._buffer[: self._limit]))
            del self._buffer[: self._limit]
        return len(data)

    def _write(self, data: bytes) -> None:
        file = self._into / f"{len(self.written):03d}.part"
        file.write_bytes(data)
        digest = hashlib.sha256(data).hexdigest()
        self.written.append({"file": file.name, "bytes": len(data), "sha256": digest})


class _Joined(io.RawIOBase):
    """All parts as one stream."""

    def __init__(self, files: list[Path]) -> None:
        self._data: Iterator[bytes] = (file.read_bytes() for file in files)
        self._rest = b""

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer from the part at hand."""
        self._rest = self._rest or next(self._data, b"")
        taken, self._rest = self._rest[: len(buffer)], self._rest[len(buffer) :]
        buffer[: len(taken)] = taken
        return len(taken)
