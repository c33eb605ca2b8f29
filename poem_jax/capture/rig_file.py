"""`rig.json`: the calibrated cameras of a capture, read and written.

    {"unit": "metre", "cameras": [{"name", "width", "height", "K", "dist", "R", "t"}, ...]}

with x_cam = R @ x_world + t, OpenCV axes, distortion k1 k2 p1 p2 k3 (may be left out = none). "cropped": true
beside the unit announces images that are cut out of larger ones: their principal points may lie anywhere.

In the file pixel (0, 0) is the *centre* of the top-left pixel, as OpenCV calibrates; in a `Rig` the image
spans [0, W] x [0, H]. So the principal point moves by half a pixel here, and nowhere else.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.geometry.camera_checks import ROTATION_TOLERANCE, has_form_of_intrinsics, rotation_error
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float

HALF_PIXEL = 0.5
"""Add to pixel coordinates that come from a file, subtract from those that go into one."""
METRES_PER_UNIT = {"metre": 1.0, "centimetre": 1e-2, "millimetre": 1e-3}
_UNIT_NAMES = {
    "metre": "metre", "meter": "metre", "m": "metre",
    "centimetre": "centimetre", "centimeter": "centimetre", "cm": "centimetre",
    "millimetre": "millimetre", "millimeter": "millimetre", "mm": "millimetre",
}  # fmt: skip
_CONVENTION = (
    "x_cam = R @ x_world + t; OpenCV axes; pixel (0,0) is the centre of the top-left pixel; "
    "distortion k1 k2 p1 p2 k3"
)
_CENTRAL = (0.2, 0.8)
"""Where in an image, as a share of its size, the principal point of a whole sensor is believed to lie."""


def read_rig(path: str | os.PathLike) -> Rig:
    """Read `rig.json` into metres and the house's pixel convention.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not JSON, a key is missing, the unit is missing or unknown, a name comes twice, a value is
            not finite, `R` is no rotation, or `K` belongs to another resolution. The message names file,
            camera, what was expected and what was found.
    """
    path = Path(path)
    content = _json(path)
    scale = METRES_PER_UNIT[_unit(content, path)]
    cameras = content.get("cameras")
    if not isinstance(cameras, list) or not cameras or not all(isinstance(entry, dict) for entry in cameras):
        raise ValueError(f"{path}: `cameras` must be a list of at least one camera; got {_short(cameras)}")
    names = tuple(str(_entry(camera, "name", f"{path}: camera {i}")) for i, camera in enumerate(cameras))
    _check_names(names, path)
    cropped = content.get("cropped", False)
    if not isinstance(cropped, bool):
        raise ValueError(f"{path}: `cropped` must be true or false; got {_short(cropped)}")
    places = [f"{path}: camera '{name}'" for name in names]
    parts = [_camera(camera, cropped, where) for camera, where in zip(cameras, places, strict=True)]
    size_wh, K, dist, T_cam_from_world = (np.stack(part) for part in zip(*parts, strict=True))
    T_cam_from_world[:, :3, 3] *= scale
    return Rig(names, size_wh, K, dist, T_cam_from_world)


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


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"no rig file at {path}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} must be a rig in JSON; it cannot be parsed: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a JSON object with `unit` and `cameras`; got {_short(content)}")
    return content


def _unit(content: dict[str, Any], path: Path) -> str:
    if "unit" not in content:
        raise ValueError(
            f"{path}: `unit` is missing; write one of {', '.join(METRES_PER_UNIT)} (the unit of every `t`)"
        )
    unit = _UNIT_NAMES.get(str(content["unit"]).lower())
    if unit is None:
        raise ValueError(
            f"{path}: `unit` must be one of {', '.join(METRES_PER_UNIT)}; got {content['unit']!r}"
        )
    return unit


def _check_names(names: tuple[str, ...], path: Path) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(
            f"{path}: camera names must differ; {', '.join(map(repr, twice))} comes more than once"
        )
    bad = [name for name in names if not name or Path(name).name != name or name in (".", "..")]
    if bad:
        raise ValueError(f"{path}: a camera's name must also serve as a file name; got {bad[0]!r}")


def _camera(camera: dict[str, Any], cropped: bool, where: str) -> tuple[Array, Array, Array, Array]:
    width, height = (_entry(camera, key, where) for key in ("width", "height"))
    if not all(isinstance(side, int) and side > 0 for side in (width, height)):
        raise ValueError(f"{where}: width and height must be whole pixels; got {width!r} x {height!r}")
    K = _array(camera, "K", (3, 3), where)
    _check_intrinsics(K, where)
    if not cropped and not _is_central(K[:2, 2] + HALF_PIXEL, np.array([width, height])):
        raise ValueError(
            f"{where}: the principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) must lie between "
            f"{_CENTRAL[0]} and {_CENTRAL[1]} of the {width} x {height} image; `K` seems to belong to "
            "another resolution: scale it, or correct width and height (if the images are cut out of larger "
            'ones, write "cropped": true beside `unit`)'
        )
    K[:2, 2] += HALF_PIXEL
    dist = _distortion(camera, where)
    T_cam_from_world = np.eye(4)
    T_cam_from_world[:3, :3] = _rotation(camera, where)
    T_cam_from_world[:3, 3] = _array(camera, "t", (3,), where)
    return np.array([width, height]), K, dist, T_cam_from_world


def _check_intrinsics(K: Array, where: str) -> None:
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not has_form_of_intrinsics(K):
        raise ValueError(
            f"{where}: `K` must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], fx, fy > 0; got {K.tolist()}"
        )


def _is_central(point_px: Array, size_wh: Array) -> bool:
    return bool(np.all((point_px >= _CENTRAL[0] * size_wh) & (point_px <= _CENTRAL[1] * size_wh)))


def _rotation(camera: dict[str, Any], where: str) -> Float[Array, "3 3"]:
    R = _array(camera, "R", (3, 3), where)
    deviation = float(rotation_error(R))
    if deviation > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError(
            f"{where}: `R` must be a rotation (R R^T = 1, det = +1); got det = {np.linalg.det(R):.4g}, "
            f"R R^T off by {deviation:.2g}"
        )
    return R


def _distortion(camera: dict[str, Any], where: str) -> Float[Array, "5"]:
    if camera.get("dist") is None:
        return np.zeros(5)
    values = np.asarray(camera["dist"], dtype=object).ravel()
    if len(values) > 5 and not any(values[5:]):
        camera = {**camera, "dist": list(values[:5])}
    if len(values) == 4:
        camera = {**camera, "dist": [*values, 0.0]}
    return _array(camera, "dist", (5,), where)


def _entry(camera: dict[str, Any], key: str, where: str) -> Any:
    if key not in camera:
        raise ValueError(f"{where}: `{key}` is missing; found {', '.join(camera) or 'nothing'}")
    return camera[key]


def _array(camera: dict[str, Any], key: str, shape: tuple[int, ...], where: str) -> Array:
    value = _entry(camera, key, where)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"{where}: `{key}` must hold numbers of shape {shape}; got {_short(value)}"
        ) from None
    if array.shape != shape:
        raise ValueError(f"{where}: `{key}` must have shape {shape}; got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{where}: `{key}` must be finite; got {array.tolist()}")
    return array


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
