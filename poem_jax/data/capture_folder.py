"""The folder of a capture: its calibration, and its images, one per camera or one folder per frame.

    DIR/rig.json or DIR/calibration/rig.json, else the calibration of another tool in DIR or DIR/calibration

    DIR/<camera>.jpg                    one frame
    DIR/frames/<frame>/<camera>.jpg     a take

`.jpg`, `.jpeg` and `.png` in either case; the images are raw: distorted, as the camera gave them. Folders
that systems make beside one's own (`.ipynb_checkpoints`, `@eaDir`, `__MACOSX`) are no frames.
"""

import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from poem_jax.calibration.read_calibration import find_calibrations, read_calibration
from poem_jax.geometry.rig import Rig
from poem_jax.io.file_names import name_key, safe_file_names
from poem_jax.io.video import ImageSource

RIG_FILES = ("rig.json", "calibration/rig.json")
SUFFIXES = (".jpg", ".jpeg", ".png")
SINGLE_FRAME = "0000"
"""Name of the only frame of a capture without `frames/`."""
SYSTEM_PREFIXES = (".", "@", "#", "$", "__")
"""Of folders that are not the user's: hidden, made by a network disk, an archive or an interpreter."""


class FramePaths(NamedTuple):
    """Where the images of one moment lie."""

    name: str
    images: tuple[ImageSource | None, ...]
    """One per camera in the rig's order; None = there is none."""
    time_s: float | None = None
    """Seconds since the take began; None = only the order is known."""


def find_frames(folder: str | os.PathLike, camera_names: Sequence[str]) -> list[FramePaths]:
    """List the frames of a capture, in natural order of their names.

    Raises:
        FileNotFoundError: The folder, or every camera's image in it, is missing.
        ValueError: A camera has two images in a frame, or a frame's name cannot be that of a folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no capture folder at {folder}")
    if (folder / "frames").is_dir():
        places = [place for place in (folder / "frames").iterdir() if place.is_dir()]
        places = sorted((p for p in places if not p.name.startswith(SYSTEM_PREFIXES)), key=natural_order)
        names = safe_file_names([place.name for place in places], f"{folder / 'frames'}: the frames' names")
        frames = [
            FramePaths(name, images_of_cameras(place, camera_names))
            for name, place in zip(names, places, strict=True)
        ]
    else:
        frames = [FramePaths(SINGLE_FRAME, images_of_cameras(folder, camera_names))]
    if not any(path for frame in frames for path in frame.images):
        raise FileNotFoundError(
            f"no image of the rig's cameras in {folder}: expected {camera_names[0]}.jpg (or .png), ..., or "
            f"frames/<frame>/{camera_names[0]}.jpg, or for each camera a video ({camera_names[0]}.mp4) or a "
            f"folder of images; found {_found(folder)}"
        )
    return frames


def find_rig(folder: str | os.PathLike, rig: str | os.PathLike | None = None) -> Rig:
    """Read the rig of a capture: the given calibration, of any kind that is read, else what is in the folder.

    Raises: FileNotFoundError, ValueError: as `read_calibration` and `find_rig_file`.
    """
    return read_calibration(find_rig_file(folder) if rig is None else rig)


def find_rig_file(folder: str | os.PathLike) -> Path:
    """Return the rig's file in a capture's folder: `rig.json`, else the one calibration of another tool.

    Raises:
        FileNotFoundError: there is none.
        ValueError: there are several, of which none is `rig.json`.
    """
    folder = Path(folder)
    places = [folder / name for name in RIG_FILES]
    found = next((place for place in places if place.is_file()), None)
    if found is not None:
        return found
    others = [
        files[0]
        for place in (folder, folder / "calibration")
        if place.is_dir()
        for files in find_calibrations(place)
    ]
    if len(others) > 1:
        names = ", ".join(str(path.relative_to(folder)) for path in others[:8])
        raise ValueError(f"{folder} holds several calibrations, {names}: say which by --rig FILE")
    if not others:
        looked = " or ".join(map(str, places))
        raise FileNotFoundError(
            f"no {looked}, nor a calibration of another tool there: no rig: pass --rig FILE, or put it there"
        )
    return others[0]


def frame_key(name: str) -> str | int:
    """Return what makes two names those of one frame: '9' is '0009', and accents may be written two ways."""
    return int(name) if name.isdecimal() else name_key(name)


def hand_names(sides: tuple[str, ...]) -> tuple[str, ...]:
    """Return `right`, `left`, or `right_0`, `right_1` where a side comes more than once."""
    return tuple(
        side if sides.count(side) == 1 else f"{side}_{sides[:i].count(side)}" for i, side in enumerate(sides)
    )


def images_of_cameras(place: Path, camera_names: Sequence[str]) -> tuple[Path | None, ...]:
    """Find every camera's image; a name's accented letters may be written in either form of Unicode.

    Raises: ValueError: a camera has two.
    """
    found: dict[str, list[Path]] = {}
    for path in sorted(place.iterdir()):
        if path.suffix.lower() in SUFFIXES:
            found.setdefault(name_key(path.stem), []).append(path)
    by_camera = [found.get(name_key(name), []) for name in camera_names]
    twice = next((paths for paths in by_camera if len(paths) > 1), None)
    if twice:
        raise ValueError(f"{place} holds two images of one camera: {twice[0].name} and {twice[1].name}")
    return tuple(paths[0] if paths else None for paths in by_camera)


def _found(folder: Path) -> str:
    """List a few images of a capture, as paths below it, for a message."""
    paths = (path for path in sorted(folder.glob("**/*")) if path.suffix.lower() in SUFFIXES)
    shown = [str(path.relative_to(folder)) for path in itertools.islice(paths, 4)]
    return ", ".join(shown[:3]) + (", ..." if len(shown) > 3 else "") or "no image"


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Return what sorts `frame_10` behind `frame_2`."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]
