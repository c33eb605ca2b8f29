"""From the cameras of a calibration file to a `Rig`: what all formats have in common, checked once."""

import logging
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.calibration.camera_values import image_size
from poem_jax.calibration.units import customary_metres, metres_of
from poem_jax.geometry.camera_checks import rotation_error
from poem_jax.geometry.distortion import stack_lenses
from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.geometry.transforms import rigid
from poem_jax.io.file_names import name_key, safe_file_names
from poem_jax.typing import Array, Float

_CENTRAL = (0.2, 0.8)
"""Where in an image, as a share of its size, the principal point of a whole sensor is believed to lie."""
_MAX_SHIFT = 5e-3
"""Metres by which rounding of `R` may move a camera against the others."""
_MAX_CAMERAS = 1000

_log = logging.getLogger(__name__)


class FileCamera(NamedTuple):
    """A camera as its file gives it: lengths in the file's unit, pixels as a `Rig` counts them."""

    name: str
    size_wh: tuple[int, int] | None
    """None = the format does not hold it."""
    K: Float[Array, "3 3"]
    dist: Float[Array, " term"]
    """Terms of `geometry.distortion`."""
    T_cam_from_world: Float[Array, "4 4"]


class Calibration(NamedTuple):
    """The cameras of a file, and what is known of their unit."""

    cameras: Sequence[FileCamera]
    unit: str | None = None
    """Of `units.METRES_PER_UNIT`, where the file or the format says it."""
    customs: tuple[str, ...] = ("metre",)
    """Otherwise: units such files are written in, the commonest first."""


def from_centres(K: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return K for images that span [0, W] x [0, H], from one that counts from the first pixel's centre."""
    K = np.array(K, np.float64)
    K[:2, 2] += HALF_PIXEL
    return K


def to_centres(K: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return K for files that count from the centre of the first pixel: the inverse of `from_centres`."""
    K = np.array(K, np.float64)
    K[:2, 2] -= HALF_PIXEL
    return K


def pose(R: Float[Array, "3 3"], t: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """Return T_cam_from_world of x_cam = R @ x_world + t."""
    return rigid(np.asarray(R, np.float64), np.asarray(t, np.float64))


def rig_of(
    calibration: Calibration,
    path: Path,
    kind: str,
    *,
    unit: str | float | None = None,
    size_wh: tuple[int, int] | None = None,
    cropped: bool = False,
) -> Rig:
    """Make the rig of the cameras of a file.

    Args:
        calibration: The cameras.
        path: Their file, for the messages.
        kind: What it was read as, for the messages.
        unit: Of the file, if the user says it: as in `units.metres_of`; it overrides what the file says.
        size_wh: Of all images, for formats that do not hold it.
        cropped: The images are cut out of larger ones, so that principal points may lie anywhere.

    Raises:
        ValueError: no camera, or one comes twice, a name that no file can have, a size that is not there, a
            principal point of another resolution, or a world so far off that rotations are too coarse.
    """
    cameras = calibration.cameras
    if not 0 < len(cameras) <= _MAX_CAMERAS:
        raise ValueError(f"{path}: a rig has 1 to {_MAX_CAMERAS} cameras; got {len(cameras)}")
    names = file_names([camera.name for camera in cameras], path)
    sizes = [_size(camera, size_wh, path) for camera in cameras]
    K = np.stack([camera.K for camera in cameras])
    T = np.stack([camera.T_cam_from_world for camera in cameras])
    if not cropped:
        for name, size, camera_K in zip(names, sizes, K, strict=True):
            _check_resolution(camera_K, size, f"{path}: camera '{name}'")
    T[:, :3, 3] *= _metres(calibration, T, path, kind, unit)
    rig = Rig(names, np.array(sizes), K, stack_lenses([camera.dist for camera in cameras]), T)
    _check_far_rotations(rig, path)
    _check_distinct(rig, path)
    return rig


def file_names(names: Sequence[str], path: Path) -> tuple[str, ...]:
    """Return the names in Unicode's composed form, so that they meet the names of files in either form.

    Raises: ValueError: one cannot be the name of a file, or two are the same.
    """
    return tuple(map(name_key, safe_file_names(names, f"{path}: the cameras' names")))


def is_central(point_px: Float[Array, "2"], size_wh: Sequence[int] | Array) -> bool:
    """Tell whether a principal point lies where that of a whole image does."""
    size = np.asarray(size_wh)
    return bool(np.all((point_px >= _CENTRAL[0] * size) & (point_px <= _CENTRAL[1] * size)))


def _size(camera: FileCamera, size_wh: tuple[int, int] | None, path: Path) -> tuple[int, int]:
    where = f"{path}: camera '{camera.name}'"
    if camera.size_wh is not None:
        if size_wh is not None and tuple(size_wh) != camera.size_wh:
            raise ValueError(
                f"{where}: its images are {camera.size_wh[0]} x {camera.size_wh[1]} by the file; got "
                f"{size_wh[0]} x {size_wh[1]}: leave the size out"
            )
        return camera.size_wh
    if size_wh is None:
        raise ValueError(
            f"{where}: this file does not hold the size of the images: `poem calibration convert {path} "
            "rig.json --image-size W H` makes a file that does"
        )
    return image_size(size_wh[0], size_wh[1], where)


def _metres(calibration: Calibration, T: Array, path: Path, kind: str, unit: str | float | None) -> float:
    said = None if calibration.unit is None else metres_of(calibration.unit)
    if unit is None:
        return customary_metres(T, calibration.customs, path, kind) if said is None else said
    given = metres_of(unit)
    if said is not None and given != said:
        _log.warning("%s is in %ss by itself; read in units of %g m, as told", path, calibration.unit, given)
    return given


def _check_resolution(K: Array, size_wh: tuple[int, int], where: str) -> None:
    if is_central(K[:2, 2], size_wh):
        return
    width, height = size_wh
    file_K = to_centres(K)
    if max(file_K[0, 0], file_K[1, 1], file_K[0, 2], file_K[1, 2]) < 10 < min(width, height):
        cause = "`K` seems to be normalised: multiply its first row by the width and its second by the height"
    else:
        cause = (
            "`K` seems to belong to another resolution: scale it, or correct width and height (if the images "
            'are cut out of larger ones, write a rig.json with "cropped": true beside `unit`)'
        )
    raise ValueError(
        f"{where}: the principal point ({file_K[0, 2]:.1f}, {file_K[1, 2]:.1f}) must lie between "
        f"{_CENTRAL[0]} and {_CENTRAL[1]} of the {width} x {height} image; {cause}"
    )


def _check_far_rotations(rig: Rig, path: Path) -> None:
    """Refuse rotations whose rounding, times the distance of the world's origin, moves the cameras."""
    distance = np.linalg.norm(rig.T_cam_from_world[:, :3, 3], axis=-1)
    shift = rotation_error(rig.T_cam_from_world[:, :3, :3]) * distance
    worst = int(shift.argmax())
    if shift[worst] > _MAX_SHIFT:
        raise ValueError(
            f"{path}: camera '{rig.names[worst]}': the world's origin is {distance[worst]:.3g} m far away, "
            f"where the rounding of `R` moves the camera by {shift[worst]:.2g} m; write more digits, or "
            "move the origin near the cameras"
        )


def _check_distinct(rig: Rig, path: Path) -> None:
    for a, b in combinations(range(rig.num_views), 2):
        T_a, T_b = rig.T_cam_from_world[a], rig.T_cam_from_world[b]
        if np.allclose(T_a, T_b, rtol=0, atol=1e-9) and np.allclose(rig.K[a], rig.K[b], rtol=0, atol=1e-9):
            raise ValueError(
                f"{path}: cameras '{rig.names[a]}' and '{rig.names[b]}' are the same camera: `K`, `R` and "
                "`t` are equal; list it once, or correct one of the two"
            )
