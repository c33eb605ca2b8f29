"""The frames of InterHand2.6M that show one hand alone, found once in its annotations and kept on disk.

The annotations of a split are JSON files of gigabytes. They are read as streams (`io/json_stream.py`), and
what is needed of the frames that pass is kept in the user's cache folder as two arrays, which every process
maps: `frames`, one row a frame, and `views`, one row an image, those of a frame side by side.

A frame passes where `joint_3d.json` says that it shows this hand only (`hand_type`, itself valid) and all 21
joints of the hand are valid, and where `MANO_NeuralAnnot.json` has a fit of it. Of `data.json` only the list
of images is read: which hand an image shows is the same for all images of a frame.
"""

import functools
import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.data.sources.annotation_cache import cache_path
from poem_jax.io.atomic import whole_file
from poem_jax.io.json_stream import stream_entries, stream_list
from poem_jax.typing import Array

_VERSION = 1
_JOINTS = 21
_SIDES = {"right": slice(0, _JOINTS), "left": slice(_JOINTS, 2 * _JOINTS)}
"""Where a hand's joints stand among the 42."""
_PARTS = ("data", "joint_3d", "MANO_NeuralAnnot")
_FRAME = np.dtype(
    [
        ("capture", "<i4"),
        ("frame", "<i4"),
        ("start", "<i8"),
        ("stop", "<i8"),
        ("joints_mm", "<f4", (_JOINTS, 3)),
        ("pose", "<f4", (48,)),
        ("shape", "<f4", (10,)),
    ]
)
"""`start` and `stop` are the frame's rows of `views`; joints in the world, in the set's own order."""
_log = logging.getLogger(__name__)


class FrameIndex(NamedTuple):
    """What is kept of a split; read-only maps of files."""

    frames: Array
    """One row a frame, by capture and frame: `_FRAME`."""
    views: Array
    """One row an image, of each frame by camera: camera, size_wh, file (below `images/<split>/`)."""


class AnnotationFiles(NamedTuple):
    """The annotation files of a split from which an index is made."""

    data: Path
    joint_3d: Path
    mano: Path

    @classmethod
    def of(cls, folder: Path, split: str) -> "AnnotationFiles":
        """Name the files in the folder of their split."""
        return cls(*(folder / f"InterHand2.6M_{split}_{part}.json" for part in _PARTS))


def open_index(files: AnnotationFiles, side: str) -> FrameIndex:
    """Return the index of one split for the hands of one side; make it where it is not yet.

    Raises:
        ValueError: An annotation file is not as it should be; names it and the frame.
    """
    paths = _cached_paths(files, side)
    if not paths[1].is_file():
        _log.info("reading the annotations %s once", files.data.parent)
        _make(files, side, *paths)
    return FrameIndex(*(_mapped(path) for path in paths[::-1]))


def _cached_paths(files: AnnotationFiles, side: str) -> tuple[Path, Path]:
    """Return where `views` and `frames` are kept: the latter is written last and makes an index whole."""
    states = [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    identity = (*states, side, _VERSION)
    views, frames = (
        cache_path("interhand", f"{files.data.stem}-{side}-{part}", *identity, suffix=".npy")
        for part in ("views", "frames")
    )
    return views, frames


@functools.lru_cache(maxsize=8)
def _mapped(path: Path) -> Array:
    # An empty file cannot be mapped.
    return np.load(path, mmap_mode="r" if path.stat().st_size > 1024 else None, allow_pickle=False)


def _make(files: AnnotationFiles, side: str, views_path: Path, frames_path: Path) -> None:
    joints = _read_joints(files.joint_3d, side)
    fits = _read_fits(files.mano, side, joints)
    images = _read_images(files.data, fits)
    kept = sorted(images)
    _log.info(
        "%s: %d frames of %s hands with all joints, %d of them with a fit, %d of these with images",
        *(files.data.parent, len(joints), side, len(fits), len(kept)),
    )
    rows = [row for key in kept for row in sorted(images[key])]
    longest = max((len(file.encode()) for _, _, file in rows), default=1)
    view = np.dtype([("camera", "S16"), ("size_wh", "<i4", (2,)), ("file", f"S{longest}")])
    _save(views_path, np.array([(cam.encode(), wh, file.encode()) for cam, wh, file in rows], view))
    stops = np.cumsum([len(images[key]) for key in kept], dtype=np.int64)
    frames = [
        (*key, stop - len(images[key]), stop, joints[key], *fits[key])
        for key, stop in zip(kept, stops, strict=True)
    ]
    _save(frames_path, np.array(frames, _FRAME))


def _save(path: Path, array: Array) -> None:
    with whole_file(path) as temporary:
        np.save(temporary, array, allow_pickle=False)


_Key = tuple[int, int]
"""Capture and frame."""


def _read_joints(path: Path, side: str) -> dict[_Key, Array]:
    found = {}
    for names, entry in stream_entries(path, 2):
        part = _SIDES[side]
        if not isinstance(entry, dict) or entry.get("hand_type") != side or not entry.get("hand_type_valid"):
            continue
        world = _numbers(entry, "world_coord", 6 * _JOINTS, path, names).reshape(2 * _JOINTS, 3)
        valid = _numbers(entry, "joint_valid", 2 * _JOINTS, path, names)
        if valid[part].all():
            found[_key(names, path)] = world[part]
    return found


def _read_fits(path: Path, side: str, wanted: dict[_Key, Array]) -> dict[_Key, tuple[Array, Array]]:
    found = {}
    for names, entry in stream_entries(path, 2):
        key = _key(names, path)
        fit = entry.get(side) if isinstance(entry, dict) else None
        if key in wanted and fit is not None:
            found[key] = _numbers(fit, "pose", 48, path, names), _numbers(fit, "shape", 10, path, names)
    return found


_Row = tuple[str, tuple[int, int], str]
"""Camera, size, file."""


def _read_images(path: Path, wanted: dict[_Key, Any]) -> dict[_Key, list[_Row]]:
    found: dict[_Key, list[_Row]] = {}
    for i, image in enumerate(stream_list(path, "images")):
        try:
            key = (int(image["capture"]), int(image["frame_idx"]))
            row = str(image["camera"]), (int(image["width"]), int(image["height"])), str(image["file_name"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path}, image {i}: it must have capture, frame_idx, camera, width, height and file_name; "
                f"{type(error).__name__}: {error}"
            ) from error
        if Path(row[2]).is_absolute() or ".." in Path(row[2]).parts:
            raise ValueError(f"{path}, image {i}: file_name leads out of the set: {row[2][:80]!r}")
        if key in wanted:
            found.setdefault(key, []).append(row)
    return found


def _key(names: tuple[str, ...], path: Path) -> _Key:
    if not all(name.isdecimal() for name in names):
        raise ValueError(f"{path}: captures and frames must be numbers; got {names}")
    return int(names[0]), int(names[1])


def _numbers(entry: Any, name: str, count: int, path: Path, names: tuple[str, ...]) -> Array:
    """Return a field's numbers in one row."""
    where = f"{path}, capture {names[0]} frame {names[1]}"
    try:
        array = np.asarray(entry[name], dtype=np.float32).reshape(-1)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{where}: no numbers `{name}`: {error}") from error
    if array.size != count:
        raise ValueError(f"{where}: `{name}` must have {count} numbers; got {array.size}")
    return array
