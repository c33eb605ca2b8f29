"""The images of a capture: one per camera, or one folder per frame.

    DIR/<camera>.jpg                    one frame
    DIR/frames/<frame>/<camera>.jpg     a take

`.jpg`, `.jpeg` and `.png` in either case; the images are raw: distorted, as the camera gave them.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

SUFFIXES = (".jpg", ".jpeg", ".png")
SINGLE_FRAME = "0000"
"""Name of the only frame of a capture without `frames/`."""


class FramePaths(NamedTuple):
    """Where the images of one moment lie."""

    name: str
    images: tuple[Path | None, ...]
    """One per camera in the rig's order; None = there is no such file."""


def find_frames(folder: str | os.PathLike, camera_names: Sequence[str]) -> list[FramePaths]:
    """List the frames of a capture, in natural order of their names.

    Raises:
        FileNotFoundError: The folder, or every camera's image in it, is missing.
        ValueError: A camera has two images of different suffix in a frame.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no capture folder at {folder}")
    if (folder / "frames").is_dir():
        places = sorted((place for place in (folder / "frames").iterdir() if place.is_dir()), key=_natural)
        frames = [FramePaths(place.name, _images(place, camera_names)) for place in places]
    else:
        frames = [FramePaths(SINGLE_FRAME, _images(folder, camera_names))]
    if not any(path for frame in frames for path in frame.images):
        raise FileNotFoundError(
            f"no image of the rig's cameras in {folder}: expected {camera_names[0]}.jpg (or .png), ..., or "
            f"frames/<frame>/{camera_names[0]}.jpg"
        )
    return frames


def _images(place: Path, camera_names: Sequence[str]) -> tuple[Path | None, ...]:
    found: dict[str, list[Path]] = {}
    for path in sorted(place.iterdir()):
        if path.suffix.lower() in SUFFIXES:
            found.setdefault(path.stem, []).append(path)
    twice = next((found[name] for name in camera_names if len(found.get(name, [])) > 1), None)
    if twice:
        raise ValueError(f"{place} holds two images of one camera: {twice[0].name} and {twice[1].name}")
    return tuple(found[name][0] if name in found else None for name in camera_names)


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]
