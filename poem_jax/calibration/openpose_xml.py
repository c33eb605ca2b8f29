"""OpenPose's cameras: a folder with one XML file of OpenCV's FileStorage for each, named by its serial.

CameraMatrix is [R | t], x_cam = R @ x_world + t, in metres; Intrinsics is K, Distortion has 8 terms. Pixels
from the centre of the first; the size of the images is not in the files.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose, to_centres
from poem_jax.calibration.camera_values import entry, image_size_of, intrinsics, number, numbers, rotation
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import lens_terms
from poem_jax.calibration.refusals import check_no_fisheye, check_term_count
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file


def is_openpose(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return document.syntax is Syntax.XML and {"CameraMatrix", "Intrinsics"} <= document.keys


def read_openpose(documents: Sequence[Document]) -> Calibration:
    """Read one file for each camera.

    Raises: ValueError: one is broken.
    """
    ordered = sorted(documents, key=lambda document: document.path.name)
    return Calibration([_camera(document.content(), document.path) for document in ordered], "metre")


def write_openpose(folder: Path, rig: Rig) -> None:
    """Write one file for each camera into a folder, in metres, with the size of the images besides.

    Raises: ValueError: a camera has a fisheye, or more than 8 terms.
    """
    check_no_fisheye(rig, "OpenPose's format")
    check_term_count(rig, 8, "OpenPose's format")
    for i, name in enumerate(rig.names):
        terms = shortest_terms(np.asarray(rig.dist[i], np.float64))
        with whole_file(folder / f"{name}.xml") as temporary:
            storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
            if not storage.isOpened():
                raise OSError(f"cannot write {folder / name}.xml")
            T = np.asarray(rig.T_cam_from_world[i], np.float64)
            storage.write("CameraMatrix", np.ascontiguousarray(T[:3]))
            storage.write("Intrinsics", to_centres(rig.K[i]))
            storage.write("Distortion", np.pad(terms, (0, 8 - len(terms)))[:, None])
            storage.write("ImageWidth", int(rig.size_wh[i][0]))
            storage.write("ImageHeight", int(rig.size_wh[i][1]))
            storage.release()


def _camera(content: Mapping[str, Any], path: Path) -> FileCamera:
    where = str(path)
    values = {
        key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in content.items()
    }
    place = numbers(entry(values, "CameraMatrix", where), (3, 4), f"{where}: `CameraMatrix`")
    K = from_centres(intrinsics(entry(values, "Intrinsics", where), where))
    dist = lens_terms(values.get("Distortion", []), f"{where}: `Distortion`")
    R = rotation(place[:, :3].tolist(), f"{where}: `CameraMatrix`")
    sides = [values.get(key) for key in ("ImageWidth", "ImageHeight")]
    size = (
        None
        if None in sides
        else image_size_of([number(side, f"{where}: the size") for side in sides], where)
    )
    return FileCamera(path.stem, size, K, dist, pose(R, place[:, 3]))
