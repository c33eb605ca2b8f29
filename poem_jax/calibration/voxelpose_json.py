"""The calibration of VoxelPose (Campus, Shelf) and of what took it over: a map of cameras by their names.

    {"0": {"R", "T", "fx", "fy", "cx", "cy", "k": k1 k2 k3, "p": p1 p2}, ...}

T is the camera's *centre*: x_cam = R @ (x_world - T). Pixels from the centre of the first, lengths in
millimetres by custom; the size of the images is not in the file.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose, to_centres
from poem_jax.calibration.camera_values import (
    entry,
    image_size_of,
    intrinsics,
    number,
    numbers,
    rotation,
    short,
    translation,
)
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import lens_terms
from poem_jax.calibration.refusals import check_no_fisheye, check_no_skew, check_term_count
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.io.atomic import whole_file

_MM = 1000.0


def is_voxelpose(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return document.syntax is Syntax.JSON and {"R", "T", "fx", "cx", "k", "p"} <= document.keys


def read_voxelpose(document: Document) -> Calibration:
    """Read the cameras of a file.

    Raises: ValueError: it is broken, or a camera is.
    """
    path, content = document.path, document.content()
    if not isinstance(content, dict) or not all(isinstance(camera, dict) for camera in content.values()):
        raise ValueError(f"{path} must hold a map of cameras by their names; got {short(content)}")
    cameras = [_camera(camera, name, f"{path}: camera '{name}'") for name, camera in content.items()]
    return Calibration(cameras, customs=("millimetre", "metre"))


def write_voxelpose(path: Path, rig: Rig) -> None:
    """Write a rig in VoxelPose's layout, in millimetres, with the size of the images besides.

    Raises: ValueError: a camera has a fisheye, skew, or more than 5 terms.
    """
    what = "VoxelPose's format"
    check_no_fisheye(rig, what)
    check_no_skew(rig, what)
    check_term_count(rig, 5, what)
    cameras = {}
    for i, name in enumerate(rig.names):
        K, T = to_centres(rig.K[i]), np.asarray(rig.T_cam_from_world[i], np.float64)
        k1, k2, p1, p2, k3 = np.asarray(rig.dist[i, :5], np.float64).tolist()
        cameras[name] = {
            "k": [[k1], [k2], [k3]],
            "p": [[p1], [p2]],
            "R": T[:3, :3].tolist(),
            "T": (_MM * invert_rigid(T)[:3, 3:]).tolist(),
            **dict(zip(("fx", "fy", "cx", "cy"), (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), strict=True)),
            "width": int(rig.size_wh[i][0]),
            "height": int(rig.size_wh[i][1]),
        }
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(cameras, indent=1), encoding="utf-8")


def _camera(camera: Mapping[str, Any], name: str, where: str) -> FileCamera:
    fx, fy, cx, cy = (
        number(entry(camera, key, where), f"{where}: `{key}`") for key in ("fx", "fy", "cx", "cy")
    )
    K = from_centres(intrinsics([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], where))
    k = numbers(entry(camera, "k", where), (3,), f"{where}: `k`")
    p = numbers(entry(camera, "p", where), (2,), f"{where}: `p`")
    dist = lens_terms([*k[:2], *p, k[2]], where)
    R = rotation(entry(camera, "R", where), where)
    centre = translation(entry(camera, "T", where), where)
    sides = [camera.get("width"), camera.get("height")]
    size = None if None in sides else image_size_of(sides, where)
    return FileCamera(name, size, K, dist, pose(R, -R @ centre))
