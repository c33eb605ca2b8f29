"""Kalibr's camera chain: `camchain.yaml`, each camera's place by the one before it, in metres.

    cam0: {camera_model: pinhole, intrinsics: [fu, fv, pu, pv], distortion_model, distortion_coeffs,
           resolution: [w, h]}
    cam1: {..., T_cn_cnm1: 4 x 4}

T_cn_cnm1 maps points of the camera before to this one; the first camera is the world. `radtan` is
k1 k2 p1 p2, `equidistant` the fisheye of `cv2.fisheye`. Pixels from the centre of the first.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose, to_centres
from poem_jax.calibration.camera_values import entry, image_size_of, intrinsics, numbers, rotation, short
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import lens_terms
from poem_jax.calibration.refusals import check_no_skew, check_term_count
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array

_log = logging.getLogger(__name__)


def is_kalibr(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return document.syntax is Syntax.YAML and {"camera_model", "intrinsics"} <= document.keys


def read_kalibr(document: Document) -> Calibration:
    """Read the cameras of a chain.

    Raises: ValueError: it is broken, a camera is, or one but the first has no place.
    """
    path, content = document.path, document.content()
    chain = (
        {
            str(name): camera
            for name, camera in content.items()
            if isinstance(camera, dict) and "intrinsics" in camera
        }
        if isinstance(content, dict)
        else {}
    )
    if not chain:
        raise ValueError(
            f"{path} must hold Kalibr's cameras by their names, cam0 and so on; got {short(content)}"
        )
    cameras: list[FileCamera] = []
    for name, camera in chain.items():
        where = f"{path}: camera '{name}'"
        T = np.eye(4)
        if cameras:
            if "T_cn_cnm1" not in camera:
                raise ValueError(
                    f"{where}: `T_cn_cnm1` is missing, its place by the camera before it: calibrate the "
                    "cameras of the rig together, not one by one"
                )
            T = _rigid(camera["T_cn_cnm1"], where) @ cameras[-1].T_cam_from_world
        cameras.append(_camera(camera, name, where, T))
    return Calibration(cameras, "metre")


def write_kalibr(path: Path, rig: Rig) -> None:
    """Write a rig as a chain; the world becomes that of its first camera, which is logged.

    Raises: ValueError: a camera has skew, or k3 or a later term.
    """
    check_no_skew(rig, "Kalibr's format")
    check_term_count(rig, 4, "Kalibr's format")
    T = np.asarray(rig.T_cam_from_world, np.float64)
    if not np.allclose(T[0], np.eye(4)):
        _log.warning(
            "%s: Kalibr's format has no world but the first camera's, '%s'; that is now the world's",
            path,
            rig.names[0],
        )
    chain: dict[str, Any] = {}
    for i, name in enumerate(rig.names):
        K, terms = to_centres(rig.K[i]), shortest_terms(np.asarray(rig.dist[i], np.float64))
        chain[name] = {
            "camera_model": "pinhole",
            "intrinsics": [float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])],
            "distortion_model": "equidistant" if rig.fisheye[i] else "radtan",
            "distortion_coeffs": terms[:4].tolist(),
            "resolution": rig.size_wh[i].tolist(),
        }
        if i:
            chain[name]["T_cn_cnm1"] = (T[i] @ invert_rigid(T[i - 1])).tolist()
    with whole_file(path) as temporary:
        temporary.write_text(yaml.safe_dump(chain, sort_keys=False, allow_unicode=True), encoding="utf-8")


def _camera(camera: Mapping[str, Any], name: str, where: str, T: Array) -> FileCamera:
    model, lens = (str(camera.get(key, "none")).lower() for key in ("camera_model", "distortion_model"))
    if model != "pinhole" or lens not in ("radtan", "equidistant", "none"):
        raise ValueError(
            f"{where}: of Kalibr's models pinhole with radtan, equidistant or none is read; got {model} with "
            f"{lens}"
        )
    fu, fv, pu, pv = numbers(camera["intrinsics"], (4,), f"{where}: `intrinsics`")
    K = from_centres(intrinsics([[fu, 0, pu], [0, fv, pv], [0, 0, 1]], where))
    terms = [] if lens == "none" else entry(camera, "distortion_coeffs", where)
    dist = lens_terms(terms, f"{where}: `distortion_coeffs`", lens == "equidistant")
    size = numbers(entry(camera, "resolution", where), (2,), f"{where}: `resolution`").tolist()
    return FileCamera(name, image_size_of(size, where), K, dist, T)


def _rigid(value: Any, where: str) -> Array:
    matrix = numbers(value, (4, 4), f"{where}: `T_cn_cnm1`")
    return pose(rotation(matrix[:3, :3].tolist(), f"{where}: `T_cn_cnm1`"), matrix[:3, 3])
