"""Names of cameras, where a file names images instead: `frames/0009/cam_0.jpg` is of `cam_0`."""

from collections.abc import Sequence
from pathlib import PurePosixPath


def camera_names(images: Sequence[str], where: str) -> list[str]:
    """Return a name for the camera of each image: its file's name, or that of a folder above it.

    `cam_0/0001.png` and `cam_1/0001.png` differ in the folder, so that names the cameras.

    Raises: ValueError: two images have the same path.
    """
    paths = [PurePosixPath(str(image).replace("\\", "/")) for image in images]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise ValueError(
            f"{where}: the image {str(twice)[:80]} comes twice; a rig has one image of each camera"
        )
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    for level in range(max(len(path.parts) for path in paths) - 1):
        folders = [path.parts[-2 - level] if len(path.parts) > 1 + level else "" for path in paths]
        if len(set(folders)) == len(folders) and all(folders):
            return folders
    return ["_".join(path.with_suffix("").parts).lstrip("/_") for path in paths]
