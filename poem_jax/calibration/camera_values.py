"""The numbers of one camera as calibration files hold them, checked value by value.

Each function takes the value as a parser gives it (lists, numbers, text), and `where`, the file and camera
that a message begins with. A value whose meaning can be guessed but not known, as a rotation vector in place
of a matrix, is refused with what to do; one that has a single meaning, as `t` as a column, is read.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from poem_jax.geometry.camera_checks import ROTATION_TOLERANCE, has_form_of_intrinsics, rotation_error
from poem_jax.typing import Array, Float

MAX_SIDE = 100_000
"""Pixels. No image is wider or higher."""

DISTORTION_KEYS = (
    "dist", "distortion", "distortions", "distCoef", "distCoeffs", "dist_coef", "dist_coeffs",
    "distortion_coefficients", "D",
)  # fmt: skip
"""Names under which calibration tools write the terms of `geometry.distortion`, in OpenCV's order."""

_LENS_WORDS = (
    "dist", "lens", "fisheye", "radial", "tangential", "coef", "equidistant", "omni", "kannala", "brandt",
    "model", "projection", "rational", "prism", "undistort",
)  # fmt: skip
_LENS_TERMS = {
    "xi",
    *(f"{letter}{i}" for letter, count in (("k", 6), ("p", 2), ("s", 4)) for i in range(count + 1)),
}
_PINHOLE = {
    "pinhole", "perspective", "opencv", "brown", "radtan", "plumb_bob", "brownconrady", "brown_conrady",
    "rational_polynomial", "standard", "full_opencv",
}  # fmt: skip
"""What the key of a lens model may say: those whose terms are the ones of `geometry.distortion`."""


def numbers(value: Any, shape: tuple[int, ...], where: str) -> Array:
    """Return nested lists as a float64 array of the given shape; a single row or column serves as a vector.

    Raises: ValueError: other things than finite real numbers, or another shape.
    """
    try:
        array = np.array(value)
        real = array.dtype.kind in "iufU" and not _holds_bool(value)
        array = array.astype(np.float64) if real else None
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None:
        raise ValueError(f"{where} must hold numbers of shape {shape}; got {short(value)}")
    if len(shape) == 1 and array.shape in ((1, *shape), (*shape, 1)):
        array = array.reshape(shape)
    if array.shape != shape:
        raise ValueError(f"{where} must have shape {shape}; got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{where} must be finite; got {short(array.tolist())}")
    return array


def image_size(width: Any, height: Any, where: str) -> tuple[int, int]:
    """Return width and height as whole pixels; 1280.0 is 1280."""
    if not all(_is_whole(side) and 0 < side <= MAX_SIDE for side in (width, height)):
        raise ValueError(
            f"{where}: width and height must be whole pixels, 1 to {MAX_SIDE}; got {short(width)} x "
            f"{short(height)}"
        )
    return int(width), int(height)


def intrinsics(value: Any, where: str) -> Float[Array, "3 3"]:
    """Return K = [[fx, s, cx], [0, fy, cy], [0, 0, 1]] as the file counts pixels."""
    hint = ""
    if _shape(value) == (4,):
        hint = "; four numbers look like fx, fy, cx, cy: write [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
    elif _shape(value) == (9,):
        hint = "; nest the nine numbers as three rows"
    if hint:
        raise ValueError(f"{where}: `K` must have shape (3, 3); got {_shape(value)}{hint}")
    K = numbers(value, (3, 3), f"{where}: `K`")
    if has_form_of_intrinsics(K) and K[0, 0] > 0 and K[1, 1] > 0:
        return K
    with np.errstate(all="ignore"):
        scaled = K / K[2, 2]
    if has_form_of_intrinsics(K.T):
        hint = "; it is transposed"
    elif K[2, 2] not in (0, 1) and has_form_of_intrinsics(scaled):
        hint = f"; divide it by its last entry, {K[2, 2]:g}"
    elif has_form_of_intrinsics(K):
        hint = "; for images that are flipped flip the image, not `K`"
    raise ValueError(
        f"{where}: `K` must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], fx, fy > 0; got {K.tolist()}{hint}"
    )


def rotation(value: Any, where: str) -> Float[Array, "3 3"]:
    """Return R, a rotation matrix."""
    hints = {
        (3,): "; three numbers look like a rotation vector: write its matrix, cv2.Rodrigues(rvec)[0]",
        (3, 1): "; three numbers look like a rotation vector: write its matrix, cv2.Rodrigues(rvec)[0]",
        (1, 3): "; three numbers look like a rotation vector: write its matrix, cv2.Rodrigues(rvec)[0]",
        (4,): "; four numbers look like a quaternion: write its matrix",
        (9,): "; nest the nine numbers as three rows",
        (3, 4): "; write its left three columns as `R` and its last one as `t`",
        (4, 4): "; write its upper left 3 x 3 as `R` and the top of its last column as `t`",
    }
    hint = hints.get(_shape(value))
    if hint is not None:
        raise ValueError(f"{where}: `R` must have shape (3, 3); got {_shape(value)}{hint}")
    R = numbers(value, (3, 3), f"{where}: `R`")
    with np.errstate(over="ignore", invalid="ignore"):
        deviation, det = float(rotation_error(R)), float(np.linalg.det(R))
    # Written so that NaN, of numbers that overflow, fails too.
    if not (deviation <= ROTATION_TOLERANCE and det > 0):
        fix = ""
        if deviation <= ROTATION_TOLERANCE:
            fix = "; it is a reflection, as left-handed axes give: negate one axis"
        raise ValueError(
            f"{where}: `R` must be a rotation (R R^T = 1, det = +1); got det = {det:.4g}, "
            f"R R^T off by {deviation:.2g}{fix}"
        )
    return R


def translation(value: Any, where: str) -> Float[Array, "3"]:
    """Return t in the file's unit; a row or a column serves."""
    hint = ""
    if _shape(value) in ((3, 4), (4, 4)):
        hint = "; write the top of its last column"
    elif _shape(value) == (4,):
        hint = "; leave out the fourth, homogeneous entry"
    if hint:
        raise ValueError(f"{where}: `t` must have shape (3,); got {_shape(value)}{hint}")
    return numbers(value, (3,), f"{where}: `t`")


def distortion(camera: Mapping[str, Any], where: str) -> Float[Array, " term"]:
    """Return the 5 or 8 terms of `geometry.distortion`, whichever of `DISTORTION_KEYS` they stand under.

    Raises:
        ValueError: the terms stand twice and differ, are too many, or belong to another model of the lens.
    """
    check_lens_keys(camera, where)
    found = {key: _terms(camera[key], key, where) for key in DISTORTION_KEYS if camera.get(key) is not None}
    if not found:
        return np.zeros(5)
    key = next(iter(found))
    for other, terms in found.items():
        if not np.array_equal(terms, found[key]):
            raise ValueError(f"{where}: `{key}` and `{other}` both give the lens, and differ; keep one")
    return found[key]


def check_lens_keys(content: Mapping[str, Any], where: str) -> None:
    """Refuse keys that say something of the lens which is not read: another name, model or layout.

    Raises: ValueError: such a key holds anything but nothing (null, false, zeros, an empty list).
    """
    for key, value in content.items():
        name = str(key).lower()
        if key in DISTORTION_KEYS or not (name in _LENS_TERMS or any(word in name for word in _LENS_WORDS)):
            continue
        if _says_nothing(value) or str(value).strip().lower().replace("-", "_") in _PINHOLE:
            continue
        raise ValueError(
            f"{where}: `{key}` says something of the lens that is not read, {short(value)}; write the terms "
            "k1 k2 p1 p2 k3 (k4 k5 k6) of OpenCV's pinhole model as `dist`; images of other lenses (fisheye) "
            "must be undistorted first"
        )


def short(value: Any) -> str:
    """Return a value as a message shows it."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def _terms(value: Any, key: str, where: str) -> Float[Array, " term"]:
    """Return 5 terms where k4, k5 and k6 are zero, else 8."""
    if isinstance(value, Mapping):
        raise ValueError(f"{where}: `{key}` must be a list k1 k2 p1 p2 k3; got {short(value)}")
    try:
        count = int(np.size(value))
    except ValueError:
        count = -1
    terms = numbers(value, (count,), f"{where}: `{key}`") if count else np.zeros(0)
    if count not in (0, 4, 5, 8, 12, 14) or terms[8:].any():
        more = "" if count <= 8 else " (thin prisms and tilted sensors are not modelled)"
        raise ValueError(
            f"{where}: `{key}` must hold 4, 5 or 8 terms, k1 k2 p1 p2 k3 k4 k5 k6{more}; got {count}: "
            f"{short(terms.tolist())}"
        )
    terms = np.concatenate([terms[:8], np.zeros(max(0, 8 - count))])
    return terms if terms[5:].any() else terms[:5]


def _says_nothing(value: Any) -> bool:
    """Tell null, false, empty and all-zero values."""
    if value is None or value is False or (isinstance(value, str | list | dict) and not value):
        return True
    try:
        return not np.array(value, np.float64).any()
    except (TypeError, ValueError, OverflowError):
        return False


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value == value // 1


def _holds_bool(value: Any) -> bool:
    return any(map(_holds_bool, value)) if isinstance(value, list | tuple) else isinstance(value, bool)


def _shape(value: Any) -> tuple[int, ...] | None:
    try:
        return np.shape(value)
    except ValueError:
        return None
