"""What is derived once from annotations too large to be read at every start, kept in the user's cache folder.

FreiHAND's vertices are 1.5 GB of JSON text, HO-3D's evaluation vertices 1 GB: `json_rows` turns such a list
into an array file of which every process maps only what it reads. Entries are named after path, size and
time of what they were made from, so that a changed file gets a new one; nothing is lost when the folder goes.
"""

import functools
import hashlib
import logging
import math
from pathlib import Path
from typing import IO

import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_stream import stream_list
from poem_jax.io.user_cache import user_cache_folder
from poem_jax.typing import Array, Float

_MAX_ROW = 2**21
"""Characters of one row: 778 vertices take 50,000."""

_log = logging.getLogger(__name__)


def cache_path(kind: str, name: str, *identity: object, suffix: str) -> Path:
    """Return where something derived is kept.

    Args:
        kind: Folder within the cache.
        name: Readable part of the file's name.
        identity: All that it depends on.
        suffix: Of the file.
    """
    digest = hashlib.sha256(repr(identity).encode()).hexdigest()[:16]
    return user_cache_folder() / "annotations" / kind / f"{name}-{digest}{suffix}"


def json_rows(path: Path, row_shape: tuple[int, ...]) -> Float[Array, "row ..."]:
    """Return a JSON list of equally shaped lists of numbers as a read-only array on disk, float32.

    The first call for a file reads its text once; memory stays small. NaN and infinity pass: who reads a row
    checks it.

    Args:
        path: The JSON file, of any size.
        row_shape: Of each element; brackets around it or within it do not count, its numbers do.

    Raises:
        ValueError: It is no such list; names the row.
    """
    status = path.stat()
    cached = cache_path(
        "json", path.stem, str(path.resolve()), status.st_size, status.st_mtime_ns, row_shape, suffix=".npy"
    )
    if not cached.is_file():
        _log.info("reading %s once (%.0f MB)", path, status.st_size / 1e6)
        _convert(path, row_shape, cached)
    return _mapped(cached)


@functools.lru_cache(maxsize=16)
def _mapped(cached: Path) -> Array:
    return np.load(cached, mmap_mode="r", allow_pickle=False)


def _convert(path: Path, row_shape: tuple[int, ...], cached: Path) -> None:
    count = 0
    with whole_file(cached) as temporary, temporary.open("wb") as stream:
        _write_header(stream, (0, *row_shape))
        for row in stream_list(path, max_value=_MAX_ROW, allow_nan=True):
            stream.write(_row(row, row_shape, path, count).tobytes())
            count += 1
        stream.seek(0)
        _write_header(stream, (count, *row_shape))


def _write_header(stream: IO[bytes], shape: tuple[int, ...]) -> None:
    """NumPy pads its headers for growing first axes: both calls write as many bytes."""
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})


def _row(row: object, shape: tuple[int, ...], path: Path, index: int) -> Array:
    try:
        array = np.asarray(row, dtype="<f4")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}, row {index}: it must be lists of numbers; {error}") from error
    if array.size != math.prod(shape):
        raise ValueError(f"{path}, row {index}: expected {shape} numbers; got shape {array.shape}")
    return array.reshape(shape)
