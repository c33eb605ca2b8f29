"""When the cameras of a take began, how fast they ran, and which part of it is wanted.

The *offset* of a camera is how many seconds it began later than the common clock: what its video shows at
t seconds was at t + offset.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from poem_jax.capture.camera_match import of_cameras
from poem_jax.io.json_file import read_json
from poem_jax.io.video import MAX_FRAMES_PER_SECOND

SYNC_FILE = "sync.json"
MAX_OFFSET_S = 1e6
_FIELDS = ("offsets_s", "frames_per_second")


class Place(NamedTuple):
    """A place in a take: one of both is None."""

    frame: int | None = None
    time_s: float | None = None


@dataclass(frozen=True)
class Timing:
    """What is asked of a take: offsets, and the part of it."""

    offsets_s: Mapping[str, float] = field(default_factory=dict)
    """By camera; those of `sync.json` hold for the others, zero for the rest."""
    start: Place = Place(frame=0)
    """The first frame; of times, that at it or after."""
    end: Place | None = None
    """The frame behind the last; None = all."""
    every: int = 1
    """Take each frame of this many."""

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"--every must be 1 or more; got {self.every}")


class Sync(NamedTuple):
    """What `sync.json` says."""

    offsets_s: dict[str, float]
    """By camera."""
    frames_per_second: dict[str, float]
    """By camera, in place of what the videos say of themselves."""


def parse_timing(offsets: str | None, start: str | None, end: str | None, every: int) -> Timing:
    """Read the options of the commands.

    Args:
        offsets: `cam_1=0.35,cam_2=-1`, seconds.
        start: Seconds (`2.5`), or a frame (`75f`); None = from the first.
        end: Likewise; None = to the last.
        every: As `Timing.every`.

    Raises:
        ValueError: One of them cannot be read.
    """
    first = Place(frame=0) if start is None else _place(start, "--start")
    last = None if end is None else _place(end, "--end")
    if last is not None:
        pairs = ((first.frame, last.frame), (first.time_s, last.time_s))
        if any(a is not None and b is not None and b <= a for a, b in pairs):
            raise ValueError(f"--end must be behind --start; got {end} and {start or 0}")
    return Timing(_offsets(offsets), first, last, every)


def read_sync(folder: str | os.PathLike, cameras: Sequence[str]) -> Sync:
    """Read `sync.json` of a capture's folder, which need not be there.

    It holds `{"offsets_s": {"cam_1": 0.35}, "frames_per_second": 29.97}`, either of them optional; the rate
    may also be one for each camera.

    Raises:
        ValueError: It holds something else, or names a camera that the rig does not have.
    """
    path = Path(folder) / SYNC_FILE
    if not path.is_file():
        return Sync({}, {})
    content = read_json(path, what="file of offsets and rates")
    if not isinstance(content, dict) or set(content) - set(_FIELDS):
        held = ", ".join(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{path} must hold an object with {' and '.join(_FIELDS)}; got {held}")
    rates = content.get("frames_per_second", {})
    if not isinstance(rates, dict):
        rates = dict.fromkeys(cameras, rates)
    given = content.get("offsets_s", {})
    if not isinstance(given, dict):
        raise ValueError(f"{path}: `offsets_s` must be seconds by camera; got {given!r}")
    offsets_s = {
        name: _checked(value, f"{path}: `offsets_s` of {name}", -MAX_OFFSET_S, MAX_OFFSET_S)
        for name, value in given.items()
    }
    frames_per_second = {
        name: _checked(value, f"{path}: `frames_per_second` of {name}", 1e-3, MAX_FRAMES_PER_SECOND)
        for name, value in rates.items()
    }
    return Sync(of_cameras(offsets_s, cameras, str(path)), of_cameras(frames_per_second, cameras, str(path)))


def _checked(value: Any, what: str, low: float, high: float) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value) or not low <= value <= high:
        raise ValueError(f"{what} must be a number from {low:g} to {high:g}; got {value!r}")
    return float(value)


def _offsets(text: str | None) -> dict[str, float]:
    offsets: dict[str, float] = {}
    for entry in [] if text is None else text.split(","):
        name, equals, number = entry.rpartition("=")
        seconds = _number(number)
        if not equals or not name.strip() or seconds is None or abs(seconds) > MAX_OFFSET_S:
            raise ValueError(f"--offsets must be like cam_1=0.35,cam_2=-1 (seconds); got {entry!r}")
        if name.strip() in offsets:
            raise ValueError(f"--offsets gives camera {name.strip()!r} twice")
        offsets[name.strip()] = seconds
    return offsets


def _place(text: str, option: str) -> Place:
    number = text.strip()
    if number.endswith("f") and number[:-1].isdecimal():
        return Place(frame=int(number[:-1]))
    seconds = _number(number.removesuffix("s"))
    if seconds is None or seconds < 0:
        raise ValueError(f"{option} must be seconds (2.5) or a frame (75f), from 0 on; got {text!r}")
    return Place(time_s=seconds)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
