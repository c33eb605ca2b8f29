"""The calibration of AssemblyHands and of Nimble's captures: a list of cameras with `ModelViewMatrix`.

The matrix maps world to camera, in millimetres and OpenCV's axes; k1 to k6, p1 and p2 are OpenCV's, pixels
count from the centre of the first. Cameras of the model OVFishEye62 are left out, with a warning: their lens
is not read, and those of the headset move.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose
from poem_jax.calibration.camera_values import (
    entry,
    image_size,
    intrinsics,
    number,
    numbers,
    rotation,
    short,
    text,
)
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import lens_terms

_log = logging.getLogger(__name__)


def is_assemblyhands(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return document.syntax is Syntax.JSON and {"ModelViewMatrix", "ImageSizeX"} <= document.keys


def read_assemblyhands(document: Document) -> Calibration:
    """Read the cameras with a lens of OpenCV's model.

    Raises: ValueError: the file is broken, a camera is, or none has such a lens.
    """
    path, content = document.path, document.content()
    if not isinstance(content, list):
        raise ValueError(f"{path} must hold a list of cameras; got {short(content)}")
    held = [entry(camera, "Camera", f"{path}: camera {i}") for i, camera in enumerate(content)]
    serials = [
        text(entry(camera, "SerialNo", f"{path}: camera {i}"), f"{path}: `SerialNo`")
        for i, camera in enumerate(held)
    ]
    left_out = [
        f"{serial} ({camera.get('DistortionModel')})"
        for serial, camera in zip(serials, held, strict=True)
        if camera.get("DistortionModel") != "OpenCV"
    ]
    if left_out:
        _log.warning(
            "%s: left out, as their model of the lens is not read: %s", path, ", ".join(left_out)[:300]
        )
    cameras = [
        _camera(camera, serial, path)
        for serial, camera in zip(serials, held, strict=True)
        if camera.get("DistortionModel") == "OpenCV"
    ]
    if not cameras:
        raise ValueError(f"{path}: no camera has a lens of the model OpenCV")
    return Calibration(cameras, "millimetre")


def _camera(camera: Mapping[str, Any], name: str, path: Path) -> FileCamera:
    where = f"{path}: camera '{name}'"

    def value(key: str) -> float:
        return number(entry(camera, key, where), f"{where}: `{key}`")

    size = image_size(value("ImageSizeX"), value("ImageSizeY"), where)
    K = from_centres(
        intrinsics([[value("fx"), 0, value("cx")], [0, value("fy"), value("cy")], [0, 0, 1]], where)
    )
    dist = lens_terms([value(key) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")], where)
    matrix = numbers(entry(camera, "ModelViewMatrix", where), (4, 4), f"{where}: `ModelViewMatrix`")
    R = rotation(matrix[:3, :3].tolist(), f"{where}: `ModelViewMatrix`")
    return FileCamera(name, size, K, dist, pose(R, np.array(matrix[:3, 3])))
