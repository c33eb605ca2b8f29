"""EasyMocap's two files, `intri.yml` and `extri.yml`, of OpenCV's FileStorage.

intri: `names`, and for each of them K_<name>, dist_<name>, and mostly H_<name> and W_<name>; extri: R_<name>,
a rotation vector, Rot_<name>, its matrix, and T_<name>. x_cam = R @ x_world + T, pixels from the centre of
the first; the unit is that of the board, metres by custom.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose, to_centres
from poem_jax.calibration.camera_values import (
    entry,
    image_size_of,
    intrinsics,
    number,
    numbers,
    rotation,
    rotation_of_vector,
    short,
    text,
    translation,
    vector_of_rotation,
)
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import lens_terms
from poem_jax.calibration.opencv_storage import as_lists
from poem_jax.calibration.refusals import check_no_fisheye
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array

INTRI, EXTRI = "intri.yml", "extri.yml"
_ALIKE = 1e-4
"""Largest difference of an entry of the two rotations of a camera that counts as rounding."""


def is_easymocap(document: Document) -> bool:
    """Tell whether a file is one of the two, whole or broken."""
    return easymocap_part(document) is not None


def easymocap_part(document: Document) -> str | None:
    """Return which of the two files it is; None = neither."""
    if document.syntax is not Syntax.OPENCV_YAML or "names" not in document.keys:
        return None
    if any(key.startswith(("Rot_", "T_")) for key in document.keys):
        return EXTRI
    return INTRI if any(key.startswith(("K_", "dist_")) for key in document.keys) else None


def read_easymocap(documents: Sequence[Document]) -> Calibration:
    """Read the two files.

    Raises: ValueError: one is missing or broken, they are of other cameras, or R_ and Rot_ disagree.
    """
    parts = {easymocap_part(document): document for document in documents}
    for part, what in ((INTRI, "the lenses"), (EXTRI, "where the cameras stand")):
        if part not in parts:
            found = documents[0].path
            raise ValueError(f"{found}: EasyMocap's {part}, {what}, is missing: put it beside {found.name}")
    intri, extri = (
        {key: as_lists(value) for key, value in parts[p].content().items()} for p in (INTRI, EXTRI)
    )
    paths = [str(parts[part].path) for part in (INTRI, EXTRI)]
    names = [_names(content, path) for content, path in zip((intri, extri), paths, strict=True)]
    if set(names[0]) != set(names[1]):
        raise ValueError(
            f"{paths[0]} is of the cameras {names[0]}, and {paths[1]} of {names[1]}: they must be the same"
        )
    return Calibration([_camera(name, intri, extri, paths) for name in names[0]])


def write_easymocap(folder: Path, rig: Rig) -> None:
    """Write `intri.yml` and `extri.yml` into a folder, in metres.

    Raises: ValueError: a camera has a fisheye.
    """
    check_no_fisheye(rig, "EasyMocap's format")
    bad = next(
        (name for name in rig.names if not name.replace("_", "").isalnum() or not name.isascii()), None
    )
    if bad is not None:
        raise ValueError(
            f"EasyMocap's format cannot hold the name '{bad}': it must be of letters, digits and _"
        )
    intri: dict[str, Any] = {}
    extri: dict[str, Any] = {}
    for i, name in enumerate(rig.names):
        T = np.asarray(rig.T_cam_from_world[i], np.float64)
        intri[f"K_{name}"] = to_centres(rig.K[i])
        intri[f"dist_{name}"] = shortest_terms(np.asarray(rig.dist[i], np.float64))[:, None]
        intri[f"H_{name}"], intri[f"W_{name}"] = int(rig.size_wh[i][1]), int(rig.size_wh[i][0])
        extri[f"R_{name}"] = vector_of_rotation(T[:3, :3])[:, None]
        extri[f"Rot_{name}"], extri[f"T_{name}"] = T[:3, :3], T[:3, 3:]
    for file, values in ((INTRI, intri), (EXTRI, extri)):
        with whole_file(folder / file) as temporary:
            _write(temporary, rig.names, values)


def _write(path: Path, names: Sequence[str], values: Mapping[str, Any]) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if not storage.isOpened():
        raise OSError(f"cannot write {path}")
    storage.startWriteStruct("names", cv2.FileNode_SEQ)
    for name in names:
        storage.write("", name)
    storage.endWriteStruct()
    for key, value in values.items():
        storage.write(key, value if isinstance(value, int) else np.ascontiguousarray(value))
    storage.release()


def _names(content: Mapping[str, Any], path: str) -> list[str]:
    names = entry(content, "names", path)
    if not isinstance(names, list) or not names:
        raise ValueError(f"{path}: `names` must be a list of cameras; got {short(names)}")
    return [text(name, f"{path}: a name of a camera") for name in names]


def _camera(
    name: str, intri: Mapping[str, Any], extri: Mapping[str, Any], paths: Sequence[str]
) -> FileCamera:
    lens, place = (f"{path}: camera '{name}'" for path in paths)
    K = from_centres(intrinsics(entry(intri, f"K_{name}", lens), lens))
    dist = lens_terms(intri.get(f"dist_{name}", []), f"{lens}: `dist_{name}`")
    sides = [intri.get(f"{side}_{name}") for side in "WH"]
    size = None
    if None not in sides:
        size = image_size_of([number(side, f"{lens}: the size") for side in sides], lens)
    t = translation(entry(extri, f"T_{name}", place), place)
    return FileCamera(name, size, K, dist, pose(_rotation(name, extri, place), t))


def _rotation(name: str, extri: Mapping[str, Any], where: str) -> Array:
    """Return the rotation that R_ and Rot_ both give, or the one that is there."""
    vector, matrix = extri.get(f"R_{name}"), extri.get(f"Rot_{name}")
    if vector is None and matrix is None:
        raise ValueError(
            f"{where}: neither `R_{name}` nor `Rot_{name}` is there; found {', '.join(list(extri)[:12])}"
        )
    if vector is None:
        return rotation(matrix, f"{where}: `Rot_{name}`")
    if np.shape(vector) == (3, 3):
        raise ValueError(
            f"{where}: `R_{name}` must be a rotation vector of 3 numbers; its matrix is `Rot_{name}`"
        )
    of_vector = rotation_of_vector(numbers(vector, (3,), f"{where}: `R_{name}`"))
    if matrix is None:
        return of_vector
    of_matrix = rotation(matrix, f"{where}: `Rot_{name}`")
    if np.abs(of_vector - of_matrix).max() > _ALIKE:
        raise ValueError(
            f"{where}: `R_{name}`, a rotation vector, and `Rot_{name}`, its matrix, differ by "
            f"{np.abs(of_vector - of_matrix).max():.2g}: correct one of them, or leave it out"
        )
    return of_matrix
