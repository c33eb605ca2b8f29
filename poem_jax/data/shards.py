"""Random access to samples in tar files: by number, from any process, nothing kept open.

Why not a library made for it: webdataset reads tars from front to end, so that a shuffle is one of a buffer
and a run cannot go on at a sample; wids, its indexed sister, wants a JSON description of the shards that the
released tars lack, walks over all headers of a shard in Python whenever it opens one, knows neither PAX nor
GNU long names, and maps whole files into memory; Grain reads ArrayRecord and Parquet, no tars. Here the index
is built once (`tar_index.py`), a sample is one `pread` of its members' span, and a set of shards is a few
arrays that a worker process can be sent.
"""

import os
import re
from collections.abc import Sequence
from glob import glob
from pathlib import Path

import numpy as np

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.tar_index import shown, tar_index
from poem_jax.typing import Array, Int

_BRACES = re.compile(r"\{(\d+)\.\.(\d+)\}")
_MAX_SHARDS = 10**5
_MAX_SAMPLE_BYTES = 2**31


class ShardSet:
    """The samples of several tar files, in the order of the files and of their members."""

    def __init__(self, paths: Sequence[Path], *, required: str | None = None) -> None:
        """Index tar files, or read their cached indices.

        Args:
            paths: at least one; each once.
            required: suffix of a member without which a sample is left out, and named in `faults`.

        Raises:
            FileNotFoundError: a file is missing; all missing ones are named.
            ValueError: no file, a file or a name twice, or no whole sample in any of them.
        """
        _check_list(paths)
        self.paths = tuple(Path(path) for path in paths)
        self._indices = tuple(tar_index(path) for path in self.paths)
        self.faults: list[CorruptSampleError] = [
            CorruptSampleError(path, str(key), str(problem))
            for path, index in zip(self.paths, self._indices, strict=True)
            for key, problem in index.faults
        ]
        self._rows = tuple(np.arange(len(index), dtype=np.int32) for index in self._indices)
        if required is not None:
            self._leave_out_samples_without(required)
        self._ends = np.cumsum([len(rows) for rows in self._rows])
        if not len(self):
            problems = "; ".join(str(fault) for fault in self.faults[:3])
            raise ValueError(f"no whole sample in {len(self.paths)} shards: {problems}")

    def _leave_out_samples_without(self, suffix: str) -> None:
        kept = []
        for path, index, rows in zip(self.paths, self._indices, self._rows, strict=True):
            codes = np.flatnonzero(index.suffixes == suffix.encode())
            has = np.add.reduceat(np.isin(index.suffix, codes), index.first[:-1]) if len(index) else rows
            self.faults += [
                CorruptSampleError(path, index.key(row), f"it has no {suffix}")
                for row in np.flatnonzero(has == 0).tolist()
            ]
            kept.append(rows[has > 0])
        self._rows = tuple(kept)

    def __len__(self) -> int:
        return int(self._ends[-1])

    @property
    def lost_samples(self) -> int:
        """About how many samples `faults` stand for.

        A shard that ends early lacks what the other shards have more (their median), or what would fit into
        its bytes behind the last whole sample, whichever is more; at least one. Any other fault is a sample.
        """
        ends_early = [index.ends_early for index in self._indices]
        whole = [len(index) for index, early in zip(self._indices, ends_early, strict=True) if not early]
        usual = int(np.median(whole)) if whole else 0
        samples = sum(map(len, self._indices))
        sample_bytes = sum(index.end for index in self._indices) / max(samples, 1)
        lost = len(self.faults)
        for path, index, early in zip(self.paths, self._indices, ends_early, strict=True):
            if early:
                behind = (path.stat().st_size - index.end) / sample_bytes if samples else 0.0
                lost += max(usual - len(index), round(behind), 1) - 1
        return lost

    @property
    def shards_of_samples(self) -> Int[Array, " sample"]:
        """Number of the shard that each sample lies in."""
        return np.repeat(np.arange(len(self._rows)), [len(rows) for rows in self._rows])

    def locate(self, index: int) -> tuple[Path, str]:
        """Return the shard and the key of a sample.

        Raises:
            IndexError: there is no such sample.
        """
        shard, row = self._find(index)
        return self.paths[shard], self._indices[shard].key(row)

    def read(self, index: int) -> dict[str, bytes]:
        """Return the files of a sample by suffix.

        Raises:
            IndexError: there is no such sample.
            CorruptSampleError: the shard is gone, or shorter than when it was indexed.
        """
        shard, row = self._find(index)
        members = self._indices[shard].members(row)
        begin = min(place for _, place, _ in members)
        length = max(place + size for _, place, size in members) - begin
        data = self._read_span(shard, row, begin, length)
        return {suffix: data[place - begin : place - begin + size] for suffix, place, size in members}

    def max_members(self, pattern: str) -> int:
        """Return the largest number of members of a sample whose suffix matches a regular expression."""
        most = 0
        for index, rows in zip(self._indices, self._rows, strict=True):
            if not len(rows):
                continue
            names = [re.fullmatch(pattern, shown(name)) is not None for name in index.suffixes]
            counts = np.add.reduceat(np.array(names, np.int64)[index.suffix], index.first[:-1])
            most = max(most, int(counts[rows].max()))
        return most

    def fingerprint(self) -> dict[str, str]:
        """Return name of each shard -> size, number of samples and a checksum of its index."""
        return {
            path.name: f"{path.stat().st_size} bytes, {len(index)} samples, index {index.digest()}"
            for path, index in zip(self.paths, self._indices, strict=True)
        }

    def _find(self, index: int) -> tuple[int, int]:
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        shard = int(np.searchsorted(self._ends, index, side="right"))
        begin = int(self._ends[shard - 1]) if shard else 0
        return shard, int(self._rows[shard][index - begin])

    def _read_span(self, shard: int, row: int, begin: int, length: int) -> bytes:
        path = self.paths[shard]
        key = self._indices[shard].key(row)
        if length > _MAX_SAMPLE_BYTES:
            raise CorruptSampleError(path, key, f"it has {length} bytes")
        try:
            # Opened for each sample: nothing to send to workers, nothing left open, and 20 us beside the
            # milliseconds of its images.
            descriptor = os.open(path, os.O_RDONLY)
            try:
                data = os.pread(descriptor, length, begin)
            finally:
                os.close(descriptor)
        except OSError as error:
            raise CorruptSampleError(path, key, f"the shard cannot be read: {error.strerror}") from error
        if len(data) < length:
            raise CorruptSampleError(
                path, key, f"the shard ends {length - len(data)} bytes too early; it has changed since opened"
            )
        return data


def expand_shards(paths: str | Path | Sequence[str | Path]) -> tuple[Path, ...]:
    """Return the tar files that a folder, a pattern, a path, or a list of these stand for.

    Args:
        paths: a folder (all its tars, in order of their names), a file, a pattern with numbers in braces
            (`DexYCB_mv_train-{000000..000019}.tar`) or with `*`, or several of these.

    Raises:
        FileNotFoundError: a folder without tars, a pattern that fits no file, or numbered files that are
            missing (named).
    """
    if isinstance(paths, str | Path):
        return _expand_one(str(paths))
    return tuple(path for entry in paths for path in _expand_one(str(entry)))


def _expand_one(text: str) -> tuple[Path, ...]:
    text = os.path.expanduser(text)
    path = Path(text)
    if path.is_dir():
        found = tuple(sorted(file for file in path.glob("*.tar") if not is_hidden(file)))
        if not found:
            raise FileNotFoundError(f"no tar file in the folder {path}; give the folder of the shards")
        return found
    if match := _BRACES.search(text):
        low, high = match.groups()
        if not int(low) <= int(high) < int(low) + _MAX_SHARDS:
            raise ValueError(f"the numbers in braces must rise, by fewer than {_MAX_SHARDS}; got {text}")
        numbers = (str(number).zfill(len(low)) for number in range(int(low), int(high) + 1))
        return tuple(p for n in numbers for p in _expand_one(text[: match.start()] + n + text[match.end() :]))
    if not path.exists() and any(letter in text for letter in "*?["):
        found = tuple(file for file in map(Path, sorted(glob(text))) if not is_hidden(file))
        if not found:
            raise FileNotFoundError(f"no file fits the pattern {text}")
        return found
    return (path,)


def is_hidden(file: Path) -> bool:
    """Tell whether a name begins with a dot: macOS's `._NAME.tar`, or a temporary file that stayed behind."""
    return file.name.startswith(".")


def _check_list(paths: Sequence[Path]) -> None:
    if not paths:
        raise ValueError("give at least one shard; got none")
    missing = [path for path in paths if not Path(path).is_file()]
    if missing:
        names = ", ".join(str(path) for path in missing[:3]) + (", ..." if len(missing) > 3 else "")
        raise FileNotFoundError(f"{len(missing)} of {len(paths)} shards are missing: {names}")
    seen: set[Path] = set()
    for path in (Path(path).resolve() for path in paths):
        if path in seen:
            raise ValueError(f"{path} is listed twice")
        seen.add(path)
    of_name: dict[str, Path] = {}
    for path in map(Path, paths):
        if path.name in of_name:
            raise ValueError(
                f"two shards have one name, by which their samples are called: {of_name[path.name]} and "
                f"{path}; leave one out if it is a copy, or give it a number of its own"
            )
        of_name[path.name] = path
