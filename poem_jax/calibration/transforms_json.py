"""`transforms.json` of nerfstudio and instant-ngp: images, their lenses, and where they were taken from.

    {"camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", ...,
     "frames": [{"file_path", "transform_matrix": 4 x 4, and any of the above}, ...]}

`transform_matrix` maps the camera to the world, with OpenGL's axes in the camera (x right, y up, z back);
the image spans [0, W] x [0, H], as here. Each image becomes a camera. The world has no unit: what COLMAP gave
is turned and scaled by most tools.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.calibration.assemble import Calibration, FileCamera, pose
from poem_jax.calibration.camera_values import (
    entry,
    image_size_of,
    intrinsics,
    number,
    numbers,
    rotation,
    short,
    text,
)
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.image_names import camera_names
from poem_jax.calibration.lens_values import lens_model, lens_terms
from poem_jax.calibration.refusals import check_no_skew, check_term_count
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_ORDER = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE_ORDER = ("k1", "k2", "k3", "k4")
_UNREAD = ("k5", "k6", "b1", "b2")


def is_transforms(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return document.syntax is Syntax.JSON and {"frames", "transform_matrix"} <= document.keys


def read_transforms(document: Document) -> Calibration:
    """Read the file.

    Raises: ValueError: it is broken, or has a lens that is not read.
    """
    path, content = document.path, document.content()
    frames = entry(content, "frames", str(path))
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise ValueError(f"{path}: `frames` must be a list of images; got {short(frames)}")
    files = [
        text(entry(frame, "file_path", f"{path}: frame {i}"), f"{path}: `file_path`")
        for i, frame in enumerate(frames)
    ]
    names = camera_names(files, str(path))
    shared = {key: value for key, value in content.items() if key != "frames"}
    return Calibration(
        [_camera({**shared, **frame}, name, path) for name, frame in zip(names, frames, strict=True)]
    )


def write_transforms(path: Path, rig: Rig) -> None:
    """Write a rig as nerfstudio reads it, in metres; the world's axes stay as they are.

    Raises: ValueError: a camera has skew or more than 5 terms, or some are fisheyes and others not.
    """
    what = "transforms.json"
    check_no_skew(rig, what)
    check_term_count(rig, 5, what)
    if rig.fisheye.any() and not rig.fisheye.all():
        raise ValueError(
            f"{what} holds one model of the lens for all cameras; this rig has fisheyes and others"
        )
    frames = []
    for i, name in enumerate(rig.names):
        K, T = np.asarray(rig.K[i], np.float64), np.asarray(rig.T_cam_from_world[i], np.float64)
        terms = shortest_terms(np.asarray(rig.dist[i], np.float64)).tolist()
        order = _FISHEYE_ORDER if rig.fisheye[i] else _ORDER
        frame = {"file_path": f"images/{name}.jpg", "w": int(rig.size_wh[i][0]), "h": int(rig.size_wh[i][1])}
        frame |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        frame |= dict(zip(order, terms, strict=True))
        frames.append({**frame, "transform_matrix": (invert_rigid(T) @ _OPENGL_FROM_OPENCV).tolist()})
    model = "OPENCV_FISHEYE" if rig.fisheye.all() else "OPENCV"
    with whole_file(path) as temporary:
        temporary.write_text(
            json.dumps({"camera_model": model, "frames": frames}, indent=1), encoding="utf-8"
        )


def _camera(values: Mapping[str, Any], name: str, path: Path) -> FileCamera:
    where = f"{path}: image '{name}'"
    size = image_size_of(
        [number(entry(values, side, where), f"{where}: `{side}`") for side in ("w", "h")], where
    )
    matrix = numbers(entry(values, "transform_matrix", where), (4, 4), f"{where}: `transform_matrix`")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError(
            f"{where}: the last row of `transform_matrix` must be 0 0 0 1; got {matrix[3].tolist()}"
        )
    R = rotation(matrix[:3, :3].tolist(), f"{where}: `transform_matrix`")
    T = invert_rigid(pose(R, matrix[:3, 3]) @ _OPENGL_FROM_OPENCV)
    return FileCamera(name, size, _intrinsics(values, size, where), _lens(values, where), T)


def _intrinsics(values: Mapping[str, Any], size: tuple[int, int], where: str) -> Array:
    """Return K from focal lengths or, in files that have none, from the angle of view (radians)."""

    def focal(key: str, angle: str, side: int, other: float | None) -> float:
        if values.get(key) is not None:
            return number(values[key], f"{where}: `{key}`")
        if values.get(angle) is not None:
            return side / 2 / np.tan(number(values[angle], f"{where}: `{angle}`") / 2)
        if other is not None:
            return other
        raise ValueError(f"{where}: `{key}` (or `{angle}`) is missing; found {', '.join(list(values)[:20])}")

    fx = focal("fl_x", "camera_angle_x", size[0], None)
    fy = focal("fl_y", "camera_angle_y", size[1], fx)
    cx, cy = (
        number(values.get(key, side / 2), f"{where}: `{key}`")
        for key, side in zip(("cx", "cy"), size, strict=True)
    )
    return intrinsics([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], where)


def _lens(values: Mapping[str, Any], where: str) -> Array:
    model = values.get("camera_model", "OPENCV")
    fisheye = lens_model(model)
    if str(model).upper() in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        fisheye = False
    if fisheye is None:
        raise ValueError(
            f"{where}: `camera_model` {short(model)} is not read, only OPENCV and OPENCV_FISHEYE"
        )
    fisheye = fisheye or values.get("is_fisheye") is True
    order = _FISHEYE_ORDER if fisheye else _ORDER
    unread = (*_UNREAD, *(() if fisheye else ("k4",)))
    said = [key for key in unread if values.get(key) not in (None, 0)]
    if said:
        raise ValueError(
            f"{where}: the terms {', '.join(said)} of its lens are not of OpenCV's model, and not read"
        )
    return lens_terms([number(values.get(key, 0), f"{where}: `{key}`") for key in order], where, fisheye)
