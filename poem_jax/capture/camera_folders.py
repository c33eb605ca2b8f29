"""The moments of a take whose cameras have a folder of images each: `cam_0/0001.jpg`, ..."""

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from poem_jax.capture.camera_match import cameras_of, match_cameras
from poem_jax.data.capture_folder import SUFFIXES, SYSTEM_PREFIXES, FramePaths

_log = logging.getLogger(__name__)


def find_camera_folders(folder: Path, cameras: Sequence[str]) -> dict[str, Path]:
    """Return the folders of images of the rig's cameras, by camera; empty where there are none.

    Raises:
        ValueError: A folder may be of several cameras, or two are of one.
    """
    places = sorted(
        place
        for place in folder.iterdir()
        if place.is_dir() and not place.name.startswith(SYSTEM_PREFIXES) and _images(place)
    )
    own = [place for place in places if cameras_of(place.name, cameras)]
    if own and len(own) < len(places):
        _log.warning(
            "folders of images that are of no camera of the rig (%s) are left out: %s",
            *(", ".join(cameras), ", ".join(place.name for place in places if place not in own)),
        )
    return match_cameras(own, cameras, "folders of images")


def folder_moments(
    folders: Mapping[str, Path],
    cameras: Sequence[str],
    offsets_s: Mapping[str, float],
    frames_per_second: float | None,
) -> list[FramePaths]:
    """Put images of one number together; of a camera that began later, those of so many numbers less.

    Args:
        folders: By camera.
        cameras: Of the rig.
        offsets_s: By camera, seconds; zero for the others.
        frames_per_second: Of all cameras; None = unknown.

    Raises:
        ValueError: An image has no number, two have one, or there are offsets without a rate.
    """
    moved = {camera: offset for camera, offset in offsets_s.items() if offset and camera in folders}
    if moved and frames_per_second is None:
        raise ValueError(
            "offsets in seconds of folders of images need their rate: put "
            f'{{"frames_per_second": 30}} into {next(iter(folders.values())).parent / "sync.json"}'
        )
    numbered: dict[str, dict[int, Path]] = {}
    for camera, place in folders.items():
        shift = round(moved.get(camera, 0.0) * (frames_per_second or 0.0))
        numbered[camera] = {number + shift: path for number, path in _numbered(place).items()}
    counts = {camera: len(images) for camera, images in numbered.items()}
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{count} ({camera})" for camera, count in counts.items())
        _log.warning(
            "the cameras have different numbers of images, %s: those of one number belong together", told
        )
    numbers = sorted(set().union(*numbered.values()))
    moments = []
    for number in numbers:
        images = tuple(numbered.get(camera, {}).get(number) for camera in cameras)
        stems = {path.stem for path in images if path is not None}
        name = stems.pop() if len(stems) == 1 and not moved else f"{number - numbers[0] * bool(moved):04d}"
        time_s = None if frames_per_second is None else (number - numbers[0]) / frames_per_second
        moments.append(FramePaths(name, images, time_s))
    return moments


def _images(place: Path) -> list[Path]:
    return [path for path in place.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]


def _numbered(place: Path) -> dict[int, Path]:
    """Return the images of a folder by the last number in their names."""
    found: dict[int, Path] = {}
    for path in sorted(_images(place)):
        numbers = re.findall(r"\d+", path.stem)
        if not numbers:
            raise ValueError(f"{path} has no number: name the images of a camera by it, as 0001{path.suffix}")
        other = found.setdefault(int(numbers[-1]), path)
        if other != path:
            raise ValueError(f"{other.name} and {path.name} in {place} have one number: rename one")
    return found
