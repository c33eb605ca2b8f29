"""Files of OpenCV's FileStorage: rigs in one file, lenses and places apart, and pairs of stereo cameras.

One file: a map for each camera with `camera_matrix`, `distortion_coefficients`, `image_width`,
`image_height`, `R` (or `rvec`) and `T` (or `tvec`); lenses and places may stand in two files, by the same
names of cameras. Stereo, as OpenCV's sample `stereo_calib` writes it: M1 D1 M2 D2 in one file, R T in the
other; the first camera is the world. x_cam = R @ x_world + T, pixels from the centre of the first.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose, to_centres
from poem_jax.calibration.camera_values import (
    entry,
    image_size,
    intrinsics,
    number,
    rotation_or_vector,
    translation,
)
from poem_jax.calibration.documents import Document, Syntax
from poem_jax.calibration.lens_values import lens_terms, says_fisheye
from poem_jax.calibration.opencv_storage import as_lists
from poem_jax.calibration.units import known_unit
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array

_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "intrinsics", "intrinsic_matrix", "K")
_LENS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "distortion", "D")
_ROTATION = ("R", "rvec", "rotation", "rotation_matrix", "rotation_vector")
_TRANSLATION = ("T", "tvec", "t", "translation", "translation_vector")
_WIDTH = ("image_width", "image_Width", "width")
_HEIGHT = ("image_height", "image_Height", "height")
_STEREO_LENSES = {"M1", "D1", "M2", "D2"}
_WHOLE, _LENSES, _PLACES = "cameras", "lenses", "places"


def is_opencv(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return opencv_part(document) is not None


def opencv_part(document: Document) -> str | None:
    """Return what a file holds: whole cameras, their lenses or their places; None = neither."""
    if document.syntax not in (Syntax.OPENCV_YAML, Syntax.XML):
        return None
    keys = document.keys
    if document.syntax is Syntax.XML and "opencv_storage" not in keys:
        return None
    lenses = bool(keys & set(_MATRIX)) or keys >= _STEREO_LENSES
    places = bool(keys & set(_ROTATION)) and bool(keys & set(_TRANSLATION))
    if lenses and places:
        return _WHOLE
    return _LENSES if lenses else _PLACES if places else None


def read_opencv(documents: Sequence[Document]) -> Calibration:
    """Read one file, or two that belong together.

    Raises: ValueError: one is broken, the other half is missing, or a camera is.
    """
    parts = {opencv_part(document) for document in documents}
    path = documents[0].path
    if _WHOLE not in parts and parts != {_LENSES, _PLACES}:
        has, lacks = (
            ("the lenses", "the places, R and T") if _LENSES in parts else ("the places", "the lenses")
        )
        raise ValueError(
            f"{path} holds {has} of cameras alone; a rig needs {lacks}, too: put the file with them beside it"
        )
    contents = [document.content() for document in documents]
    merged = {key: value for content in contents for key, value in content.items()}
    if merged.keys() >= _STEREO_LENSES:
        return Calibration(_stereo(merged, path))
    names = [name for name in merged if isinstance(merged[name], dict)]
    if not names:
        raise ValueError(
            f"{path} holds one camera, and a rig several: expected a map of `camera_matrix`, "
            f"`distortion_coefficients`, R and T for each by its name; found {', '.join(list(merged)[:12])}"
        )
    cameras = []
    for name in names:
        held = {key: value for content in contents for key, value in _map(content.get(name)).items()}
        if set(held) & {*_MATRIX, *_ROTATION, *_TRANSLATION}:
            cameras.append(_camera({**_shared_size(merged), **held}, name, path))
    return Calibration(cameras, known_unit(merged.get("unit")))


def write_opencv(path: Path, rig: Rig) -> None:
    """Write a rig as one file, YAML or, if its name ends so, XML; in metres."""
    for name in rig.names:
        if not (name[0].isalpha() and name.replace("_", "").replace("-", "").isalnum() and name.isascii()):
            raise ValueError(
                f"OpenCV's files cannot hold the name '{name}': it must be of letters, digits, - and _"
            )
    with whole_file(path) as temporary:
        storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
        if not storage.isOpened():
            raise OSError(f"cannot write {path}")
        storage.write("unit", "metre")
        for i, name in enumerate(rig.names):
            T = np.asarray(rig.T_cam_from_world[i], np.float64)
            storage.startWriteStruct(name, cv2.FileNode_MAP)
            storage.write("image_width", int(rig.size_wh[i][0]))
            storage.write("image_height", int(rig.size_wh[i][1]))
            storage.write("camera_matrix", to_centres(rig.K[i]))
            terms = shortest_terms(np.asarray(rig.dist[i], np.float64))
            storage.write("distortion_coefficients", np.ascontiguousarray(terms[None]))
            storage.write("fisheye", int(rig.fisheye[i]))
            storage.write("R", np.ascontiguousarray(T[:3, :3]))
            storage.write("T", np.ascontiguousarray(T[:3, 3:]))
            storage.endWriteStruct()
        storage.release()


def _stereo(content: Mapping[str, Any], path: Path) -> list[FileCamera]:
    """Return the two cameras of a stereo pair; their names are those of their matrices' numbers."""
    cameras = []
    for number_, T in (("1", np.eye(4)), ("2", pose(*_place(content, str(path))))):
        where = f"{path}: camera {number_}"
        K = from_centres(intrinsics(as_lists(content[f"M{number_}"]), where))
        dist = lens_terms(as_lists(content[f"D{number_}"]), f"{where}: `D{number_}`")
        cameras.append(FileCamera(f"cam_{number_}", _size(content, where), K, dist, T))
    return cameras


def _camera(held: Mapping[str, Any], name: str, path: Path) -> FileCamera:
    where = f"{path}: camera '{name}'"
    fisheye = held.get("fisheye", 0)
    model = {key: value for key, value in held.items() if key not in (*_MATRIX, *_LENS, "fisheye")}
    is_fish = says_fisheye(model, where) or fisheye in (1, "true", "True", True)
    K = from_centres(intrinsics(as_lists(_one_of(held, _MATRIX, where)), where))
    terms = next((held[key] for key in _LENS if key in held), [])
    dist = lens_terms(as_lists(terms), f"{where}: its distortion", is_fish)
    return FileCamera(name, _size(held, where), K, dist, pose(*_place(held, where)))


def _place(held: Mapping[str, Any], where: str) -> tuple[Array, Array]:
    R = rotation_or_vector(as_lists(_one_of(held, _ROTATION, where)), where)
    return R, translation(as_lists(_one_of(held, _TRANSLATION, where)), where)


def _size(held: Mapping[str, Any], where: str) -> tuple[int, int] | None:
    width = next((held[key] for key in _WIDTH if key in held), None)
    height = next((held[key] for key in _HEIGHT if key in held), None)
    if width is None or height is None:
        return None
    return image_size(number(width, f"{where}: the width"), number(height, f"{where}: the height"), where)


def _shared_size(content: Mapping[str, Any]) -> dict[str, Any]:
    return {key: content[key] for key in (*_WIDTH, *_HEIGHT) if key in content}


def _one_of(held: Mapping[str, Any], names: Sequence[str], where: str) -> Any:
    key = next((name for name in names if name in held), names[0])
    return entry(held, key, where)


def _map(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
