"""`rig.json`: the calibrated cameras of a capture, read and written.

    {"unit": "metre", "cameras": [{"name", "width", "height", "K", "dist", "R", "t"}, ...]}

with x_cam = R @ x_world + t, OpenCV axes, distortion k1 k2 p1 p2 k3, or k1 k2 p1 p2 k3 k4 k5 k6 (may be left
out = none). "cropped": true beside the unit announces images that are cut out of larger ones: their principal
points may lie anywhere.

In the file pixel (0, 0) is the *centre* of the top-left pixel, as OpenCV calibrates; in a `Rig` the image
spans [0, W] x [0, H]. So the principal point moves by half a pixel here, and nowhere else.
"""

import json
import logging
import os
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.calibration.camera_values import (
    DISTORTION_KEYS,
    check_lens_keys,
    distortion,
    image_size,
    intrinsics,
    rotation,
    short,
    translation,
)
from poem_jax.geometry.camera_checks import rotation_error
from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.io.atomic import whole_file
from poem_jax.io.file_names import name_key, safe_file_names
from poem_jax.io.json_file import read_json
from poem_jax.typing import Array

METRES_PER_UNIT = {"metre": 1.0, "centimetre": 1e-2, "millimetre": 1e-3}
_SYMBOLS = {"metre": "m", "centimetre": "cm", "millimetre": "mm"}
_UNIT_NAMES = {
    name: unit
    for unit, symbol in _SYMBOLS.items()
    for name in (symbol, unit, f"{unit}s", unit.replace("metre", "meter"), unit.replace("metre", "meters"))
}
_CONVENTION = (
    "x_cam = R @ x_world + t; OpenCV axes; pixel (0,0) is the centre of the top-left pixel; "
    "distortion k1 k2 p1 p2 k3"
)
_KEYS = {"unit", "convention", "cropped", "cameras"}
_CAMERA_KEYS = {"name", "width", "height", "K", "R", "t", *DISTORTION_KEYS}
_CENTRAL = (0.2, 0.8)
"""Where in an image, as a share of its size, the principal point of a whole sensor is believed to lie."""
_MAX_SHIFT = 5e-3
"""Metres by which rounding of `R` may move a camera against the others."""

_log = logging.getLogger(__name__)


def read_rig(path: str | os.PathLike) -> Rig:
    """Read `rig.json` into metres and the house's pixel convention.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not JSON, a key comes twice or is missing, the unit is missing or unknown, a name or a
            camera comes twice, a value is not finite, `R` is no rotation, `K` belongs to another resolution,
            or a key says something of the lens that is not read. The message names file,
            camera, what was expected and what was found.
    """
    path = Path(path)
    content = read_json(path, what="rig file", allow_nan=True)
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a JSON object with `unit` and `cameras`; got {short(content)}")
    check_lens_keys(content, str(path))
    scale = METRES_PER_UNIT[_unit(content, path)]
    cameras = content.get("cameras")
    if not isinstance(cameras, list) or not cameras or not all(isinstance(entry, dict) for entry in cameras):
        raise ValueError(f"{path}: `cameras` must be a list of at least one camera; got {short(cameras)}")
    names = _names(cameras, path)
    cropped = content.get("cropped", False)
    if not isinstance(cropped, bool):
        raise ValueError(f"{path}: `cropped` must be true or false; got {short(cropped)}")
    places = [f"{path}: camera '{name}'" for name in names]
    parts = [_camera(camera, cropped, where) for camera, where in zip(cameras, places, strict=True)]
    size_wh, K, dist, T_cam_from_world = zip(*parts, strict=True)
    terms = max(map(len, dist))
    dist = [np.pad(lens, (0, terms - len(lens))) for lens in dist]
    rig = Rig(names, np.stack(size_wh), np.stack(K), np.stack(dist), np.stack(T_cam_from_world))
    rig.T_cam_from_world[:, :3, 3] *= scale
    _check_far_rotations(rig, path)
    _check_distinct(rig, path)
    _warn_of_keys(content, path)
    return rig


def write_rig(path: str | os.PathLike, rig: Rig) -> Path:
    """Write a rig as `rig.json` in metres; `read_rig` gives it back."""
    central = all(_is_central(K[:2, 2], size) for K, size in zip(rig.K, rig.size_wh, strict=True))
    cameras = []
    for i, name in enumerate(rig.names):
        K = np.array(rig.K[i], np.float64)
        K[:2, 2] -= HALF_PIXEL
        T_cam_from_world = np.asarray(rig.T_cam_from_world[i], np.float64)
        camera = {
            "name": name,
            "width": int(rig.size_wh[i][0]),
            "height": int(rig.size_wh[i][1]),
            "K": K.tolist(),
            "dist": np.asarray(rig.dist[i], np.float64).tolist(),
            "R": T_cam_from_world[:3, :3].tolist(),
            "t": T_cam_from_world[:3, 3].tolist(),
        }
        cameras.append(camera)
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
    unit = _UNIT_NAMES.get(str(content["unit"]).strip().lower())
    if unit is None:
        raise ValueError(f"{path}: `unit` must be one of {known}; got {short(content['unit'])}")
    return unit


def _names(cameras: list[dict[str, Any]], path: Path) -> tuple[str, ...]:
    """Return the names in Unicode's composed form, so that they meet the names of files in either form."""
    names = [_entry(camera, "name", f"{path}: camera {i}") for i, camera in enumerate(cameras)]
    text = [str(name) if isinstance(name, str | int) else short(name) for name in names]
    return tuple(map(name_key, safe_file_names(text, f"{path}: the cameras' names")))


def _camera(camera: dict[str, Any], cropped: bool, where: str) -> tuple[Array, Array, Array, Array]:
    width, height = image_size(_entry(camera, "width", where), _entry(camera, "height", where), where)
    K = intrinsics(_entry(camera, "K", where), where)
    if not cropped:
        _check_resolution(K, width, height, where)
    K[:2, 2] += HALF_PIXEL
    dist = distortion(camera, where)
    T_cam_from_world = np.eye(4)
    T_cam_from_world[:3, :3] = rotation(_entry(camera, "R", where), where)
    T_cam_from_world[:3, 3] = translation(_entry(camera, "t", where), where)
    return np.array([width, height]), K, dist, T_cam_from_world


def _check_resolution(K: Array, width: int, height: int, where: str) -> None:
    if _is_central(K[:2, 2] + HALF_PIXEL, np.array([width, height])):
        return
    if max(K[0, 0], K[1, 1], K[0, 2], K[1, 2]) < 10 < min(width, height):
        cause = "`K` seems to be normalised: multiply its first row by the width and its second by the height"
    else:
        cause = (
            "`K` seems to belong to another resolution: scale it, or correct width and height (if the images "
            'are cut out of larger ones, write "cropped": true beside `unit`)'
        )
    raise ValueError(
        f"{where}: the principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) must lie between {_CENTRAL[0]} and "
        f"{_CENTRAL[1]} of the {width} x {height} image; {cause}"
    )


def _is_central(point_px: Array, size_wh: Array) -> bool:
    return bool(np.all((point_px >= _CENTRAL[0] * size_wh) & (point_px <= _CENTRAL[1] * size_wh)))


def _check_far_rotations(rig: Rig, path: Path) -> None:
    """Refuse rotations whose rounding, times the distance of the world's origin, moves the cameras."""
    distance = np.linalg.norm(rig.T_cam_from_world[:, :3, 3], axis=-1)
    shift = rotation_error(rig.T_cam_from_world[:, :3, :3]) * distance
    worst = int(shift.argmax())
    if shift[worst] > _MAX_SHIFT:
        raise ValueError(
            f"{path}: camera '{rig.names[worst]}': the world's origin is {distance[worst]:.3g} m far away, "
            f"where the rounding of `R` moves the camera by {shift[worst]:.2g} m; write more digits, or "
            "move the origin near the cameras"
        )


def _check_distinct(rig: Rig, path: Path) -> None:
    for a, b in combinations(range(rig.num_views), 2):
        T_a, T_b = rig.T_cam_from_world[a], rig.T_cam_from_world[b]
        if np.allclose(T_a, T_b, rtol=0, atol=1e-9) and np.allclose(rig.K[a], rig.K[b], rtol=0, atol=1e-9):
            raise ValueError(
                f"{path}: cameras '{rig.names[a]}' and '{rig.names[b]}' are the same camera: `K`, `R` and "
                "`t` are equal; list it once, or correct one of the two"
            )


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


def _entry(camera: dict[str, Any], key: str, where: str) -> Any:
    if key not in camera:
        raise ValueError(f"{where}: `{key}` is missing; found {', '.join(map(str, camera)) or 'nothing'}")
    return camera[key]
