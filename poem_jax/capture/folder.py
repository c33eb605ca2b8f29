"""The images of a capture: one per camera, or one folder per frame.

    DIR/<camera>.jpg                    one frame
    DIR/frames/<frame>/<camera>.jpg     a take

`.jpg`, `.jpeg` and `.png` in either case. Images are RGB uint8 and raw: distorted, as the camera gave them.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.typing import Array, UInt8

SUFFIXES = (".jpg", ".jpeg", ".png")
SINGLE_FRAME = "0000"
"""Name of the only frame of a capture without `frames/`."""
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"


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


def read_image(path: str | os.PathLike, size_wh: tuple[int, int]) -> UInt8[Array, "h w 3"]:
    """Read an RGB image and check that it is of the size for which the camera was calibrated.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It cannot be decoded, or has another size than the rig says.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}")
    data = path.read_bytes()
    bgr = _decode(data)
    if bgr is None:
        raise ValueError(
            f"{path} cannot be read as an image ({len(data)} bytes): it is damaged or of another kind"
        )
    height, width = bgr.shape[:2]
    if (width, height) != tuple(size_wh):
        raise ValueError(
            f"{path} is {width} x {height}; the rig was calibrated at {size_wh[0]} x {size_wh[1]}: "
            "use the images as calibrated, or scale `K`, width and height in the rig"
        )
    return np.ascontiguousarray(bgr[..., ::-1])


def _decode(data: bytes) -> UInt8[Array, "h w 3"] | None:
    """Decode to BGR; None where that fails, also for a JPEG that breaks off (OpenCV would give a part)."""
    if not data or (data.startswith(_JPEG_START) and data.rfind(_JPEG_END) < data.rfind(_JPEG_SCAN)):
        return None
    # The calibration belongs to the stored pixels: a rotation flag must not turn them.
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)


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
