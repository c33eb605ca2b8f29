"""Where the members of a tar file lie, so that any sample can be read at once: found once, then cached.

A sample is what webdataset takes for one: successive members whose names agree up to the first dot of the
file name. The index is kept beside the tar (`.NAME.tar.index.npz`), or in the user's cache folder where that
cannot be written, and holds for the size and time of change of the tar that it was made from.

Only headers are read to make it, by Python's `tarfile` (ustar, GNU and PAX). A tar that breaks off keeps the
samples before the cut; whatever was left out is told in `faults`.
"""

import hashlib
import logging
import os
import tarfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO, NamedTuple

import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.io.npz_file import read_npz
from poem_jax.io.user_cache import user_cache_folder
from poem_jax.typing import Array, Int

_VERSION = 2
_BLOCK = 512
_MAX_MEMBER_BYTES = 2**30
"""Of one file of a sample; ours are images and labels."""
_DAMAGED, _EMPTY = "the shard is damaged", "the shard is empty"
"""How faults of a whole file begin."""
_MAX_SUFFIXES = 2**16

_log = logging.getLogger(__name__)


class TarIndex(NamedTuple):
    """Samples of one tar file: sample i has the members `first[i]` to `first[i + 1]`."""

    keys: Array
    """Names of the samples, bytes as in the tar."""
    start: Int[Array, " sample"]
    """Where the data of the first member begins in the file, bytes."""
    first: Int[Array, " sample+1"]
    offset: Array
    """uint32 (member,): of a member's data from `start` of its sample, bytes."""
    size: Array
    """uint32 (member,), bytes."""
    suffix: Array
    """uint16 (member,): which of `suffixes` it has."""
    suffixes: Array
    """What follows the first dot of a name, in lower case, bytes as in the tar."""
    faults: Array
    """Pairs (key, what is wrong), text (n, 2): samples that were left out."""

    def __len__(self) -> int:
        return len(self.start)

    def key(self, sample: int) -> str:
        """Return the name of a sample."""
        return shown(self.keys[sample])

    def members(self, sample: int) -> list[tuple[str, int, int]]:
        """Return (suffix, offset in the file, size) of every member of a sample."""
        span = slice(self.first[sample], self.first[sample + 1])
        places = self.start[sample] + self.offset[span].astype(np.int64)
        names = [shown(self.suffixes[code]) for code in self.suffix[span]]
        return list(zip(names, places.tolist(), self.size[span].tolist(), strict=True))

    @property
    def ends_early(self) -> bool:
        """Whether samples are missing that nobody can name, as the file is damaged or empty."""
        return any(str(problem).startswith((_DAMAGED, _EMPTY)) for _, problem in self.faults)

    @property
    def end(self) -> int:
        """Where the data of the last sample end in the file, bytes."""
        if not len(self):
            return 0
        span = slice(self.first[-2], self.first[-1])
        return int(self.start[-1] + (self.offset[span].astype(np.int64) + self.size[span]).max())

    def digest(self) -> str:
        """Return a checksum of the names and places of all samples."""
        digest = hashlib.sha256()
        for name in ("keys", "start", "first", "offset", "size"):
            digest.update(np.ascontiguousarray(getattr(self, name)).tobytes())
        return digest.hexdigest()[:32]


def shown(name: bytes) -> str:
    """Return a name of a tar as text that can be printed; bytes that are no UTF-8 appear as `\\xe9`."""
    return bytes(name).decode(errors="backslashreplace")


def tar_index(path: str | Path) -> TarIndex:
    """Return the index of a tar file, from its cache where that still holds.

    Raises:
        FileNotFoundError: no such file.
        ValueError: as `build_index`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no shard at {path}")
    status = path.stat()
    stamp = np.array([_VERSION, status.st_size, status.st_mtime_ns], np.int64)
    places = _cache_places(path)
    for place in places:
        if (cached := _read_cache(place, stamp)) is not None:
            return cached
    _log.info("indexing %s", path)
    made = build_index(path)
    _write_cache(places, made, stamp)
    return made


def build_index(path: Path) -> TarIndex:
    """Read the headers of a tar file, and nothing of the cache.

    Raises:
        OSError: it cannot be read.
        ValueError: more than 65,536 different endings of names.
    """
    faults: list[tuple[str, str]] = []
    groups = _whole_samples(_groups(path, faults), faults)
    keys = [key for key, _ in groups]
    members = [member for _, group in groups for member in group]
    start = np.array([group[0].place for _, group in groups], np.int64)
    first = np.cumsum([0, *(len(group) for _, group in groups)], dtype=np.int32)
    suffixes = sorted({member.suffix for member in members})
    if len(suffixes) > _MAX_SUFFIXES:
        raise ValueError(
            f"{path} holds files of {len(suffixes)} different endings, as .{shown(_bytes(suffixes[0]))[:100]}"
            "; the name of a sample ends at the first dot of a file's name, so it can hold none itself: "
            "rename the files"
        )
    code = {suffix: i for i, suffix in enumerate(suffixes)}
    places = np.array([member.place for member in members], np.int64)
    return TarIndex(
        keys=_stored(keys),
        start=start,
        first=first,
        offset=(places - np.repeat(start, np.diff(first))).astype(np.uint32),
        size=np.array([member.size for member in members], np.uint32),
        suffix=np.array([code[member.suffix] for member in members], np.uint16),
        suffixes=_stored(suffixes),
        faults=np.array([[shown(_bytes(text)) for text in fault] for fault in faults], np.str_).reshape(
            -1, 2
        ),
    )


def _stored(names: list[str]) -> Array:
    return np.array([_bytes(name) for name in names], np.bytes_) if names else np.zeros(0, "S1")


def _bytes(name: str) -> bytes:
    """Undo what `tarfile` does to names that are no UTF-8."""
    return name.encode(errors="surrogateescape")


class _Member(NamedTuple):
    suffix: str
    place: int
    size: int


_Group = tuple[str, list[_Member]]


def _groups(path: Path, faults: list[tuple[str, str]]) -> list[_Group]:
    """Return successive members with one key; what stops the reader early goes to `faults`."""
    groups: list[_Group] = []
    size = path.stat().st_size
    cut: str | None = None
    with path.open("rb") as stream:
        try:
            for key, member in _members(stream, size):
                if not groups or groups[-1][0] != key:
                    groups.append((key, []))
                groups[-1][1].append(member)
        except (tarfile.TarError, _CutError) as error:
            cut = str(error)
            if isinstance(error, _CutError) and error.key is not None and groups:
                # The sample in which the cut lies.
                groups = groups[: -1 if groups[-1][0] == error.key else None]
    if cut is not None:
        last = f"the last sample before is {groups[-1][0]}" if groups else "no sample is whole"
        faults.append((groups[-1][0] if groups else "-", f"{_DAMAGED}: {cut}; {last}"))
    elif not groups:
        faults.append(("-", f"{_EMPTY}: it holds no file"))
    return groups


class _CutError(Exception):
    """The tar ends before its end; `key` is the sample in which it does, if known."""

    def __init__(self, problem: str, key: str | None = None) -> None:
        super().__init__(problem)
        self.key = key


def _members(stream: BinaryIO, file_size: int) -> Iterator[tuple[str, _Member]]:
    """Yield (key, member) in the order of the file."""
    with tarfile.open(fileobj=stream, mode="r:") as archive:
        for entry in archive:
            if not entry.isreg():
                continue
            if entry.issparse() or entry.size > _MAX_MEMBER_BYTES:
                raise _CutError(f"{entry.name[:200]} is sparse or has {entry.size} bytes")
            key, suffix = _split(entry.name)
            if entry.offset_data + entry.size > file_size:
                missing = entry.offset_data + entry.size - file_size
                raise _CutError(f"it breaks off in {entry.name[:200]}, {missing} bytes before its end", key)
            yield key, _Member(suffix, entry.offset_data, entry.size)
        stream.seek(archive.offset)
        rest = stream.read(_BLOCK)
    if len(rest) < _BLOCK or any(rest):
        what = "there is no end mark" if not rest else "what follows is no header of a file"
        raise _CutError(f"it breaks off at byte {file_size if not rest else archive.offset}: {what}")


def _split(name: str) -> tuple[str, str]:
    """Split a member's name at the first dot of its last part."""
    path = PurePosixPath(name)
    stem, _, suffix = path.name.partition(".")
    return str(path.with_name(stem)) if stem else name, suffix.lower()


def _whole_samples(groups: list[_Group], faults: list[tuple[str, str]]) -> list[_Group]:
    """Leave out samples that come twice; the first of them stays."""
    kept: dict[str, list[_Member]] = {}
    for key, members in groups:
        names = [member.suffix for member in members]
        twice = sorted({name for name in names if names.count(name) > 1})
        if key in kept:
            faults.append((key, "this key comes twice in the shard; the second sample is left out"))
        elif twice:
            faults.append((key, f"{', '.join(twice)} come twice in this sample, or two samples have its key"))
        else:
            kept[key] = members
    return list(kept.items())


def _cache_places(path: Path) -> tuple[Path, Path]:
    name = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:32]
    beside = path.with_name(f".{path.name}.index.npz")
    return beside, user_cache_folder() / "tar_index" / f"{name}.npz"


def _read_cache(place: Path, stamp: Int[Array, "3"]) -> TarIndex | None:
    """Return a cached index if it was made from the same file; None also where it is damaged."""
    if not place.is_file():
        return None
    try:
        arrays = read_npz(place, required=("stamp", *TarIndex._fields))
    except ValueError as error:
        _log.warning("the index is made again: %s", error)
        return None
    index = TarIndex(*(arrays[name] for name in TarIndex._fields))
    if not np.array_equal(arrays["stamp"], stamp):
        return None
    if not _holds_together(index, int(stamp[1])):
        _log.warning("the index is made again: %s is damaged", place)
        return None
    return index


def _holds_together(index: TarIndex, file_size: int) -> bool:
    samples, members = len(index.start), len(index.offset)
    if any(array.ndim != 1 for array in index[:7]) or index.first.shape != (samples + 1,):
        return False
    if len(index.keys) != samples or not len(index.size) == len(index.suffix) == members:
        return False
    counts = np.diff(index.first)
    if index.first[0] != 0 or index.first[-1] != members or (counts < 1).any():
        return False
    ends = np.repeat(index.start, counts) + index.offset + index.size
    codes = index.suffix.max(initial=0)
    return bool((ends <= file_size).all() and (members == 0 or codes < len(index.suffixes)))


def _write_cache(places: tuple[Path, ...], index: TarIndex, stamp: Int[Array, "3"]) -> None:
    problems = []
    for place in places:
        try:
            with whole_file(place) as temporary, temporary.open("wb") as stream:
                np.savez(stream, stamp=stamp, **index._asdict())
            return
        except OSError as error:
            problems.append(f"{os.fspath(place)}: {error.strerror}")
    _log.warning("the index will be made again next time; it could not be kept (%s)", "; ".join(problems))
