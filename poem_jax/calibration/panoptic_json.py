"""The calibration of CMU Panoptic: cameras with K, distCoef, R, t and resolution, in centimetres.

x_cam = R @ x_world + t, distCoef k1 k2 p1 p2 k3, pixels from the centre of the first.
"""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose, to_centres
from poem_jax.calibration.camera_values import (
    entry,
    image_size_of,
    intrinsics,
    numbers,
    rotation,
    short,
    text,
    translation,
)
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import lens_terms
from poem_jax.calibration.refusals import check_no_fisheye, check_term_count
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file

_CM = 100.0

_log = logging.getLogger(__name__)


def is_panoptic(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    keys = document.keys
    return document.syntax is Syntax.JSON and "unit" not in keys and {"distCoef", "resolution"} <= keys


def read_panoptic(document: Document) -> Calibration:
    """Read the cameras of a file; of Panoptic's own those of kind `hd`, where there are any.

    Raises: ValueError: it is broken, or a camera is.
    """
    path, content = document.path, document.content()
    listed = entry(content, "cameras", str(path))
    if not isinstance(listed, list) or not all(isinstance(camera, dict) for camera in listed):
        raise ValueError(f"{path}: `cameras` must be a list of cameras; got {short(listed)}")
    hd = [camera for camera in listed if camera.get("type") == "hd"]
    if hd and len(hd) < len(listed):
        _log.warning(
            "%s: the %d cameras of type hd are read, not the %d others", path, len(hd), len(listed) - len(hd)
        )
    return Calibration([_camera(camera, i, path) for i, camera in enumerate(hd or listed)], "centimetre")


def write_panoptic(path: Path, rig: Rig) -> None:
    """Write a rig in Panoptic's layout, in centimetres.

    Raises: ValueError: a camera has a fisheye, or more than 5 terms.
    """
    check_no_fisheye(rig, "Panoptic's format")
    check_term_count(rig, 5, "Panoptic's format")
    cameras = []
    for i, name in enumerate(rig.names):
        T = np.asarray(rig.T_cam_from_world[i], np.float64)
        cameras.append(
            {
                "name": name,
                "type": "hd",
                "resolution": rig.size_wh[i].tolist(),
                "K": to_centres(rig.K[i]).tolist(),
                "distCoef": shortest_terms(np.asarray(rig.dist[i], np.float64)).tolist(),
                "R": T[:3, :3].tolist(),
                "t": (_CM * T[:3, 3:]).tolist(),
            }
        )
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps({"cameras": cameras}, indent=1), encoding="utf-8")


def _camera(camera: dict[str, Any], index: int, path: Path) -> FileCamera:
    name = text(entry(camera, "name", f"{path}: camera {index}"), f"{path}: the name of camera {index}")
    where = f"{path}: camera '{name}'"
    size = numbers(entry(camera, "resolution", where), (2,), f"{where}: `resolution`").tolist()
    K = from_centres(intrinsics(entry(camera, "K", where), where))
    dist = lens_terms(camera.get("distCoef", []), f"{where}: `distCoef`")
    R, t = rotation(entry(camera, "R", where), where), translation(entry(camera, "t", where), where)
    return FileCamera(name, image_size_of(size, where), K, dist, pose(R, t))
