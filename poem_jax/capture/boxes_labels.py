"""What a file of boxes or key points says beside them: sides, frames, times, cameras, detector."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from poem_jax.data.capture_folder import frame_key
from poem_jax.io.file_names import safe_file_names
from poem_jax.typing import Array, Float

SIDES = ("left", "right")


def sides_of(content: Mapping[str, Array], path: Path) -> tuple[str, ...]:
    """Return `hand_side`; ValueError where it is missing or names no side."""
    if "hand_side" not in content:
        raise ValueError(f"{path}: `hand_side (H,)` is missing; it says 'left' or 'right' for each hand")
    sides = tuple(side.strip().lower() for side in _texts(content["hand_side"]))
    wrong = [side for side in sides if side not in SIDES]
    if wrong or not sides:
        raise ValueError(
            f"{path}: `hand_side` must hold 'left' or 'right'; got {wrong[0] if wrong else 'none'!r}"
        )
    return sides


def frames_of(content: Mapping[str, Array], num_frames: int, path: Path) -> tuple[str, ...] | None:
    """Return the names of the frames, None where there are none; ValueError where they are wrong."""
    if "frames" not in content:
        return None
    names = _texts(content["frames"])
    if len(names) != num_frames:
        raise ValueError(f"{path}: `frames` must name {num_frames} frames; got {len(names)}")
    safe_file_names(names, f"{path}: `frames`")
    if len({frame_key(name) for name in names}) < len(names):
        raise ValueError(f"{path}: `frames` must differ from each other, also as numbers; got {names[:6]}")
    return names


def times_of(content: Mapping[str, Array], num_frames: int, path: Path) -> Float[Array, " frame"] | None:
    """Return the times of the frames, seconds; None where there are none, ValueError where they are wrong."""
    if "time_s" not in content:
        return None
    times = content["time_s"]
    if times.shape != (num_frames,) or not np.issubdtype(times.dtype, np.number):
        raise ValueError(
            f"{path}: `time_s` must be the seconds of {num_frames} frames; got {times.dtype} {times.shape}"
        )
    times = times.astype(np.float64)
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError(
            f"{path}: `time_s` must be seconds, each later than the one before; got {_few(times)}"
        )
    return times


def offsets_of(content: Mapping[str, Array], num_views: int, path: Path) -> Float[Array, " view"] | None:
    """Return the cameras' offsets, seconds; None where there are none, ValueError where they are wrong."""
    if "offsets_s" not in content:
        return None
    offsets = content["offsets_s"]
    numbers = np.issubdtype(offsets.dtype, np.number)
    if offsets.shape != (num_views,) or not numbers or not np.isfinite(offsets).all():
        raise ValueError(
            f"{path}: `offsets_s` must be the seconds of {num_views} views; got {offsets.tolist()}"
        )
    return offsets.astype(np.float64)


def cameras_of_views(content: Mapping[str, Array], num_views: int, path: Path) -> tuple[str, ...] | None:
    """Return the names of the views, None where there are none; ValueError where they are wrong."""
    if "cameras" not in content:
        return None
    names = _texts(content["cameras"])
    if len(names) != num_views:
        raise ValueError(f"{path}: `cameras` must name {num_views} views; got {len(names)}")
    return safe_file_names(names, f"{path}: `cameras`")


def detector_of(content: Mapping[str, Array], path: Path) -> str | None:
    """Return what found the key points, None where the file does not say."""
    if "detector" not in content:
        return None
    names = _texts(content["detector"])
    if len(names) != 1:
        raise ValueError(f"{path}: `detector` must be one name; got {len(names)}")
    return names[0].strip() or None


def _texts(array: Array) -> tuple[str, ...]:
    """Return text or numbers as text; whole floats as whole numbers."""
    values = np.atleast_1d(array).ravel().tolist()
    if array.dtype.kind == "S":
        return tuple(value.decode("utf-8", "backslashreplace") for value in values)
    return tuple(str(int(v)) if isinstance(v, float) and v.is_integer() else str(v) for v in values)


def _few(times: Array) -> str:
    wrong = np.flatnonzero(~np.isfinite(times) | (np.diff(times, prepend=-np.inf) <= 0))
    at = int(wrong[0])
    return f"{times[max(at - 1, 0) : at + 1].tolist()} at frame {at}"
