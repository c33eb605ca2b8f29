"""COLMAP's text files: `cameras.txt`, the lenses, and `images.txt`, where each image was taken from.

    CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]
    IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME        (and a line of points, which may be empty)

x_cam = R @ x_world + t, OpenCV axes; the image spans [0, W] x [0, H], as here. Every image becomes a camera,
named by the part of its path that tells it from the others. Lengths are of no unit unless the model was
scaled to one.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from poem_jax.calibration.assemble import Calibration, FileCamera, pose
from poem_jax.calibration.camera_values import image_size, intrinsics, numbers, short
from poem_jax.calibration.documents import Document, Syntax, is_number
from poem_jax.calibration.image_names import camera_names
from poem_jax.calibration.lens_values import lens_terms
from poem_jax.calibration.refusals import check_no_skew, check_term_count
from poem_jax.geometry.distortion import shortest_terms
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import quaternion_from_rotation
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array

CAMERAS, IMAGES = "cameras.txt", "images.txt"
MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}
"""Models that are read, and their parameters."""
_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def is_colmap(document: Document) -> bool:
    """Tell whether a file is one of the two, whole or broken."""
    return colmap_part(document) is not None


def colmap_part(document: Document) -> str | None:
    """Return which of the two files it is; None = neither."""
    if document.syntax is not Syntax.LINES:
        return None
    comments = " ".join(key for key in document.keys if " " in key)
    if "CAMERA_ID, MODEL, WIDTH" in comments:
        return CAMERAS
    if "IMAGE_ID, QW, QX" in comments:
        return IMAGES
    first = next(iter(_lines(document.text)), "").split()
    if len(first) > 4 and first[1].isupper() and not is_number(first[1]) and first[0].isdigit():
        return CAMERAS
    if len(first) > 9 and all(map(is_number, first[:9])) and not is_number(first[-1]):
        return IMAGES
    return None


def read_colmap(documents: Sequence[Document]) -> Calibration:
    """Read the two files.

    Raises: ValueError: one of them is missing or broken, or a model of the lens is not read.
    """
    parts = {colmap_part(document): document for document in documents}
    for part, what in ((CAMERAS, "the lenses"), (IMAGES, "where the cameras stand")):
        if part not in parts:
            found = documents[0].path
            raise ValueError(f"{found}: COLMAP's {part}, {what}, is missing: put it beside {found.name}")
    lenses = _read_cameras(parts[CAMERAS])
    path = parts[IMAGES].path
    rows = _image_rows(parts[IMAGES])
    names = camera_names([row[9] for row in rows], str(path))
    cameras = []
    for name, row in zip(names, rows, strict=True):
        where = f"{path}: image '{name}'"
        quaternion, t = np.split(numbers(row[1:8], (7,), where), [4])
        if abs(np.linalg.norm(quaternion) - 1) > 1e-3:
            raise ValueError(f"{where}: QW QX QY QZ must be of length 1; got {short(row[1:5])}")
        if row[8] not in lenses:
            raise ValueError(f"{where}: its camera {row[8]} is not in {parts[CAMERAS].path}")
        size, K, dist = lenses[row[8]]
        R = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        cameras.append(FileCamera(name, size, K, dist, pose(R, t)))
    return Calibration(cameras)


def write_colmap(folder: Path, rig: Rig) -> None:
    """Write `cameras.txt`, `images.txt` and an empty `points3D.txt` into a folder, in metres.

    Raises: ValueError: a camera has skew, thin prisms or a tilted sensor.
    """
    check_no_skew(rig, "COLMAP")
    check_term_count(rig, 8, "COLMAP")
    cameras, images = (
        ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"],
        ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"],
    )
    for i, name in enumerate(rig.names):
        K, terms = np.asarray(rig.K[i], np.float64), shortest_terms(np.asarray(rig.dist[i], np.float64))
        focal = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        model = "OPENCV_FISHEYE" if rig.fisheye[i] else "FULL_OPENCV" if terms.any() else "PINHOLE"
        lens = [] if model == "PINHOLE" else [*terms, *np.zeros(max(0, 8 - len(terms)))]
        lens = list(terms) if rig.fisheye[i] else lens
        width, height = rig.size_wh[i]
        cameras.append(f"{i + 1} {model} {width} {height} {_words([*focal, *lens])}")
        T = np.asarray(rig.T_cam_from_world[i], np.float64)
        place = _words([*quaternion_from_rotation(T[:3, :3]), *T[:3, 3]])
        images += [f"{i + 1} {place} {i + 1} {name}.jpg", ""]
    for file, lines in ((CAMERAS, cameras), (IMAGES, images), ("points3D.txt", ["# No points."])):
        with whole_file(folder / file) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _read_cameras(document: Document) -> dict[str, tuple[tuple[int, int], Array, Array]]:
    lenses = {}
    for line in _lines(document.text):
        words = line.split()
        where = f"{document.path}: camera {words[0]}"
        if len(words) < 5:
            raise ValueError(
                f"{where}: a line must be CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]; got {short(line)}"
            )
        model, params = words[1], words[4:]
        if model not in MODELS:
            raise ValueError(
                f"{where}: its model {model[:40]} is not read, only {', '.join(MODELS)}: let COLMAP "
                "estimate one of these, or undistort the images with it"
            )
        keys = MODELS[model].split()
        if len(params) != len(keys):
            raise ValueError(
                f"{where}: {model} has {len(keys)} parameters, {MODELS[model]}; got {len(params)}"
            )
        if not all(map(is_number, words[2:])):
            raise ValueError(f"{where} must hold numbers; got {short(line)}")
        values = dict(zip(keys, numbers(params, (len(keys),), where), strict=True))
        fx, fy = values.get("fx", values.get("f")), values.get("fy", values.get("f"))
        K = intrinsics([[fx, 0, values["cx"]], [0, fy, values["cy"]], [0, 0, 1]], where)
        order = ("k1", "k2", "k3", "k4") if model.endswith("FISHEYE") else _ORDER
        dist = lens_terms([values.get(key, 0.0) for key in order], where, model.endswith("FISHEYE"))
        if words[0] in lenses:
            raise ValueError(f"{where} comes twice")
        lenses[words[0]] = image_size(float(words[2]), float(words[3]), where), K, dist
    if not lenses:
        raise ValueError(f"{document.path} holds no camera")
    return lenses


def _image_rows(document: Document) -> list[list[str]]:
    """Return the words of every other line; a line of points may be empty, but is there."""
    lines = [line for line in document.text.splitlines() if not line.lstrip().startswith("#")]
    while lines and not lines[0].strip():
        del lines[0]
    rows = []
    for number, line in enumerate(lines[::2]):
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        if len(words) < 10 or not all(map(is_number, words[:8])):
            raise ValueError(
                f"{document.path}: image {number} must be IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and "
                f"a line of points, which may be empty, after it; got {short(line)}"
            )
        points = lines[2 * number + 1].split() if 2 * number + 1 < len(lines) else []
        if len(points) % 3 or (points and not is_number(points[-1])):
            raise ValueError(
                f"{document.path}: after the line of image {number} must stand one of its points, X Y "
                f"POINT3D_ID each, which may be empty; got {short(lines[2 * number + 1])}"
            )
        rows.append([word.strip() for word in words])
    if not rows:
        raise ValueError(f"{document.path} holds no image")
    return rows


def _lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def _words(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
