"""`rig.json`: the calibrated cameras of a capture, read and written.

    {"unit": "metre", "cameras": [{"name", "width", "height", "K", "dist", "R", "t"}, ...]}

with x_cam = R @ x_world + t, OpenCV axes, `dist` the 4, 5, 8, 12 or 14 terms of OpenCV's pinhole (may be left
out = none), or with "fisheye": true in the camera the 4 of `cv2.fisheye`. "cropped": true beside the unit
announces images that are cut out of larger ones: their principal points may lie anywhere.

In the file pixel (0, 0) is the *centre* of the top-left pixel, as OpenCV calibrates; in a `Rig` the image
spans [0, W] x [0, H]. So the principal point moves by half a pixel here, and nowhere else.
"""

import json
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.calibration.assemble import (
    Calibration,
    FileCamera,
    file_names,
    from_centres,
    is_central,
    pose,
    rig_of,
    to_centres,
)
from poem_jax.calibration.camera_values import (
    entry,
    image_size,
    intrinsics,
    rotation,
    short,
    translation,
)
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import DISTORTION_KEYS, distortion, says_fisheye
from poem_jax.calibration.units import METRES_PER_UNIT, known_unit
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json

_CONVENTION = (
    "x_cam = R @ x_world + t; OpenCV axes; pixel (0,0) is the centre of the top-left pixel; "
    "distortion k1 k2 p1 p2 k3, or k1 k2 k3 k4 of cv2.fisheye where `fisheye` is true"
)
_KEYS = {"unit", "convention", "cropped", "cameras"}
_CAMERA_KEYS = {"name", "width", "height", "K", "R", "t", *DISTORTION_KEYS}

_log = logging.getLogger(__name__)


def read_rig(
    path: str | os.PathLike,
    *,
    unit: str | float | None = None,
    size_wh: tuple[int, int] | None = None,
) -> Rig:
    """Read `rig.json` into metres and the house's pixel convention.

    Args:
        path: The file.
        unit: Of its lengths, in place of what the file says (`units.metres_of`).
        size_wh: What all its images must have; None = anything.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not JSON, a key comes twice or is missing, the unit is missing or unknown, a name or a
            camera comes twice, a value is not finite, a size is not the given one, `R` is no rotation, `K`
            belongs to another resolution, or a key says something of the lens that is not read. The message
            names file, camera, what was expected and what was found.
    """
    path = Path(path)
    content = read_json(path, what="rig file", allow_nan=True)
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a JSON object with `unit` and `cameras`; got {short(content)}")
    fisheye = says_fisheye(content, str(path))
    known = _unit(content, path)
    cameras = content.get("cameras")
    if not isinstance(cameras, list) or not cameras or not all(isinstance(entry, dict) for entry in cameras):
        raise ValueError(f"{path}: `cameras` must be a list of at least one camera; got {short(cameras)}")
    names = _names(cameras, path)
    cropped = content.get("cropped", False)
    if not isinstance(cropped, bool):
        raise ValueError(f"{path}: `cropped` must be true or false; got {short(cropped)}")
    found = [_camera(camera, name, fisheye, path) for camera, name in zip(cameras, names, strict=True)]
    calibration = Calibration(found, known)
    rig = rig_of(calibration, path, "our rig.json", unit=unit, size_wh=size_wh, cropped=cropped)
    _warn_of_keys(content, path)
    return rig


def write_rig(path: str | os.PathLike, rig: Rig) -> Path:
    """Write a rig as `rig.json` in metres; `read_rig` gives it back."""
    central = all(is_central(K[:2, 2], size) for K, size in zip(rig.K, rig.size_wh, strict=True))
    cameras = []
    for i, name in enumerate(rig.names):
        T_cam_from_world = np.asarray(rig.T_cam_from_world[i], np.float64)
        camera = {
            "name": name,
            "width": int(rig.size_wh[i][0]),
            "height": int(rig.size_wh[i][1]),
            "K": to_centres(rig.K[i]).tolist(),
            "dist": shortest_terms(np.asarray(rig.dist[i], np.float64)).tolist(),
            "R": T_cam_from_world[:3, :3].tolist(),
            "t": T_cam_from_world[:3, 3].tolist(),
        }
        cameras.append(camera | {"fisheye": True} if rig.fisheye[i] else camera)
    with whole_file(path) as temporary:
        content = {"unit": "metre", "convention": _CONVENTION, "cropped": not central, "cameras": cameras}
        temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")
    return Path(path)


def _unit(content: dict[str, Any], path: Path) -> str:
    known = ", ".join(METRES_PER_UNIT)
    if "unit" not in content:
        found = ", ".join(map(str, content)) or "nothing"
        raise ValueError(
            f"{path}: `unit` is missing; write one of {known} (the unit of every `t`); found {found}"
        )
    unit = known_unit(content["unit"])
    if unit is None:
        raise ValueError(f"{path}: `unit` must be one of {known}; got {short(content['unit'])}")
    return unit


def _names(cameras: list[dict[str, Any]], path: Path) -> tuple[str, ...]:
    """Return the names in Unicode's composed form, so that they meet the names of files in either form."""
    names = [entry(camera, "name", f"{path}: camera {i}") for i, camera in enumerate(cameras)]
    return file_names([str(name) if isinstance(name, str | int) else short(name) for name in names], path)


def _camera(camera: dict[str, Any], name: str, fisheye: bool, path: Path) -> FileCamera:
    where = f"{path}: camera '{name}'"
    size_wh = image_size(entry(camera, "width", where), entry(camera, "height", where), where)
    K = from_centres(intrinsics(entry(camera, "K", where), where))
    R = rotation(entry(camera, "R", where), where)
    t = translation(entry(camera, "t", where), where)
    return FileCamera(name, size_wh, K, distortion(camera, where, fisheye), pose(R, t))


def _warn_of_keys(content: dict[str, Any], path: Path) -> None:
    """Say which lists and objects nothing reads, and which are taken for `dist`, though of another name."""
    unread = {key for key in content.keys() - _KEYS if isinstance(content[key], list | dict)}
    lenses = set()
    for camera in content["cameras"]:
        unread |= {key for key in camera.keys() - _CAMERA_KEYS if isinstance(camera[key], list | dict)}
        if "dist" not in camera:
            lenses |= {key for key in DISTORTION_KEYS if camera.get(key)}
    if lenses:
        _log.warning("%s: %s is read as `dist`, k1 k2 p1 p2 k3 (k4 k5 k6)", path, _quoted(lenses))
    if unread:
        _log.warning("%s: %s are not read", path, _quoted(unread))


def _quoted(keys: set[str]) -> str:
    return ", ".join(f"`{key}`" for key in sorted(keys))


def is_rig(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return (
        document.syntax is Syntax.JSON
        and "cameras" in document.keys
        and bool(document.keys & {"unit", "units", "convention"})
    )
