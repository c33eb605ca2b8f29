"""Which file or folder is of which camera, by name."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from poem_jax.io.file_names import name_key


def match_cameras(paths: Sequence[Path], cameras: Sequence[str], what: str) -> dict[str, Path]:
    """Find the camera of every file or folder.

    A name without its ending is that of its camera: as it is, else in other letters of either case, else
    with words beside it (`cam0_take 2` is of `cam_0`, and not of `cam_01`).

    Args:
        paths: The files or folders, all of some camera.
        cameras: Names of the rig.
        what: They are, for messages: "videos".

    Returns: by the camera's name.

    Raises:
        ValueError: One is of no camera, may be of several, or two are of one.
    """
    found: dict[str, Path] = {}
    for path in paths:
        own = cameras_of(_stem(path), cameras)
        if len(own) != 1:
            fault = f"may be of any of {', '.join(own)}" if own else "is of no camera of the rig"
            raise ValueError(
                f"{path.name} {fault}; the {what} are {_listed(paths)}, the rig's cameras "
                f"{', '.join(cameras)}: name each as its camera, or move away what is not of the take"
            )
        other = found.setdefault(own[0], path)
        if other != path:
            raise ValueError(
                f"{other.name} and {path.name} are both of camera '{own[0]}'; the {what} are "
                f"{_listed(paths)}: leave one for each camera"
            )
    return found


def cameras_of(name: str, cameras: Sequence[str]) -> list[str]:
    """Return the cameras that a name may mean, those of the closest kind of agreement."""
    same = [camera for camera in cameras if name_key(camera) == name_key(name)]
    if same:
        return same
    folded = [camera for camera in cameras if _folded(camera) == _folded(name)]
    if folded:
        return folded
    words = _words(name)
    within = {camera: len(_words(camera)) for camera in cameras if _is_within(_words(camera), words)}
    return [camera for camera, length in within.items() if length == max(within.values())]


def of_cameras(entries: Mapping[str, float], cameras: Sequence[str], where: str) -> dict[str, float]:
    """Return what a file or an option gives for cameras, by their names as the rig writes them.

    Raises:
        ValueError: A name is not in the rig; `where` says who gives it.
    """
    keys = {name_key(camera): camera for camera in cameras}
    unknown = [name for name in entries if name_key(name) not in keys]
    if unknown:
        raise ValueError(
            f"{where}: there is no camera {unknown[0]!r} in the rig; it has {', '.join(cameras)}"
        )
    return {keys[name_key(name)]: value for name, value in entries.items()}


def _stem(path: Path) -> str:
    return path.name if path.is_dir() else path.stem


def _folded(name: str) -> str:
    return name_key(name_key(name).casefold())


def _words(name: str) -> list[str]:
    """Split into letters and whole numbers: `Cam_01` is `cam`, `1`."""
    parts = re.findall(r"\d+|[^\W\d_]+", _folded(name))
    return [str(int(part)) if part.isdecimal() else part for part in parts]


def _is_within(short: list[str], words: list[str]) -> bool:
    places = range(len(words) - len(short) + 1)
    return bool(short) and any(words[at : at + len(short)] == short for at in places)


def _listed(paths: Sequence[Path]) -> str:
    names = [path.name for path in paths]
    return ", ".join(names[:12]) + ", ..." * (len(names) > 12)
