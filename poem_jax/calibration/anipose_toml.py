"""The TOML of anipose, and of the tools that took it over: freemocap, Pose2Sim, caliscope, sleap-anipose.

    [cam_0]
    name, size = [w, h], matrix (3 x 3), distortions, rotation, translation, fisheye = true or false

with x_cam = R @ x_world + t and pixels from the centre of the first, as OpenCV has them. `rotation` is a
vector, in caliscope's older files a matrix; its newer ones have tables [cameras.0]. anipose and freemocap are
in the unit of their board's squares, which is millimetres by custom; caliscope and Pose2Sim in metres.
"""

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose, to_centres
from poem_jax.calibration.camera_values import (
    entry,
    image_size_of,
    intrinsics,
    numbers,
    rotation_or_vector,
    text,
    translation,
    vector_of_rotation,
)
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import lens_terms
from poem_jax.calibration.units import known_unit
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file

_log = logging.getLogger(__name__)


def is_anipose(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return document.syntax is Syntax.TOML and {"matrix", "distortions"} <= document.keys


def kind_of(document: Document) -> str:
    """Return which tool's file it is."""
    if document.keys & {"port", "rotation_count", "capture_volume"}:
        return "caliscope's TOML"
    if document.keys & {"charuco_square_size", "path_to_recorded_videos", "groundplane_calibration"}:
        return "freemocap's TOML"
    return "anipose's TOML"


def read_anipose(document: Document) -> Calibration:
    """Read the cameras of a file.

    Raises: ValueError: it is broken, or has no cameras, or these have no place.
    """
    content = document.content()
    tables = content | {f"cam_{key}": table for key, table in _table(content.get("cameras")).items()}
    cameras = []
    for key, table in tables.items():
        if not isinstance(table, dict) or "matrix" not in table:
            continue
        if table.get("ignore") is True:
            _log.warning("%s: camera '%s' is to be ignored, and is left out", document.path, key)
            continue
        cameras.append(_camera(table, key, document.path))
    if not cameras:
        raise ValueError(f"{document.path}: no table of a camera has a `matrix`; found {', '.join(content)}")
    unit = known_unit(_table(content.get("metadata")).get("unit"))
    if unit is None and kind_of(document) == "caliscope's TOML":
        unit = "metre"
    return Calibration(cameras, unit, ("millimetre", "metre"))


def write_anipose(path: Path, rig: Rig) -> None:
    """Write a rig as anipose does, in millimetres."""
    lines = []
    for i, name in enumerate(rig.names):
        K, T = to_centres(rig.K[i]), np.asarray(rig.T_cam_from_world[i], np.float64)
        lines += [
            f"[cam_{i}]",
            f"name = {json.dumps(name)}",
            f"size = {rig.size_wh[i].tolist()}",
            f"matrix = {K.tolist()}",
            f"distortions = {shortest_terms(np.asarray(rig.dist[i], np.float64)).tolist()}",
            f"rotation = {vector_of_rotation(T[:3, :3]).tolist()}",
            f"translation = {(1e3 * T[:3, 3]).tolist()}",
            f"fisheye = {'true' if rig.fisheye[i] else 'false'}",
            "",
        ]
    lines += ["[metadata]", 'unit = "millimetre"', ""]
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def _camera(table: Mapping[str, Any], key: str, path: Path) -> FileCamera:
    name = text(table.get("name", key), f"{path}: the name of [{key}]")
    where = f"{path}: camera '{name}'"
    missing = [part for part in ("rotation", "translation") if part not in table]
    if missing:
        raise ValueError(
            f"{where} has no {' and no '.join(f'`{part}`' for part in missing)}: it is calibrated by itself, "
            "and not yet placed among the others; let the tool calibrate the extrinsics, too"
        )
    size = numbers(entry(table, "size", where), (2,), f"{where}: `size`").tolist()
    K = from_centres(intrinsics(table["matrix"], where))
    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise ValueError(f"{where}: `fisheye` must be true or false; got {fisheye!r}")
    dist = lens_terms(table.get("distortions", []), f"{where}: `distortions`", fisheye)
    R = rotation_or_vector(table["rotation"], where)
    t = translation(table["translation"], where)
    return FileCamera(name, image_size_of(size, where), K, dist, pose(R, t))


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
