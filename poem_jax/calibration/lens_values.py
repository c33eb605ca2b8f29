"""The lens of one camera as calibration files hold it, checked: its terms, and which model they are of.

What a file says of the lens is never passed over: a key that is not known, or a model that is not, is refused
by its name.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from poem_jax.calibration.camera_values import numbers, short
from poem_jax.geometry.distortion import FISHEYE_TERM, fisheye_lens, shortest_terms
from poem_jax.typing import Array, Float

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
    "rational_polynomial", "standard", "full_opencv", "none",
}  # fmt: skip
_FISHEYE = {
    "fisheye", "opencv_fisheye", "equidistant", "kannala_brandt", "kannalabrandt", "kannala_brandt4", "kb4",
}  # fmt: skip
"""What the key of a lens model may say: those whose terms are the ones of `geometry.distortion`."""


def distortion(camera: Mapping[str, Any], where: str, fisheye: bool = False) -> Float[Array, " term"]:
    """Return the terms of the lens, whichever of `DISTORTION_KEYS` they stand under.

    Args:
        camera: What the file says of the camera.
        where: Begins the messages.
        fisheye: Whether the file says of all its cameras that they have fisheyes.

    Raises:
        ValueError: the terms stand twice and differ, are too many or too few, or belong to another model.
    """
    fisheye = says_fisheye(camera, where) or fisheye
    found = {key: camera[key] for key in DISTORTION_KEYS if camera.get(key) is not None}
    lenses = {key: lens_terms(value, f"{where}: `{key}`", fisheye) for key, value in found.items()}
    if not lenses:
        if fisheye:
            raise ValueError(f"{where} has a fisheye, and no terms of it: write k1 k2 k3 k4 as `dist`")
        return np.zeros(5)
    key = next(iter(lenses))
    for other, terms in lenses.items():
        if not np.array_equal(terms, lenses[key]):
            raise ValueError(f"{where}: `{key}` and `{other}` both give the lens, and differ; keep one")
    return lenses[key]


def says_fisheye(content: Mapping[str, Any], where: str) -> bool:
    """Tell whether a camera, or a whole file, is said to have fisheyes.

    Raises: ValueError: a key says something else of the lens which is not read: another name, model or
        layout; unless it holds nothing (null, false, zeros, an empty list).
    """
    fisheye = False
    for key, value in content.items():
        name = str(key).lower().replace("reprojection", "")
        if key in DISTORTION_KEYS or not (name in _LENS_TERMS or any(word in name for word in _LENS_WORDS)):
            continue
        if _says_nothing(value) or lens_model(value) is False:
            continue
        if lens_model(value) or (name in ("fisheye", "is_fisheye") and value is True):
            fisheye = True
            continue
        raise ValueError(
            f"{where}: `{key}` says something of the lens that is not read, {short(value)}; write the terms "
            "k1 k2 p1 p2 k3 (k4 k5 k6 (s1 s2 s3 s4 (tau_x tau_y))) of OpenCV's pinhole model as `dist`, or "
            'the k1 k2 k3 k4 of `cv2.fisheye` and "fisheye": true; images of other lenses must be '
            "undistorted first"
        )
    return fisheye


def lens_model(name: Any) -> bool | None:
    """Tell whether a model's name is that of a fisheye (True) or pinhole (False); None = another model."""
    plain = str(name).strip().lower().replace("-", "_")
    return plain in _FISHEYE if plain in _FISHEYE | _PINHOLE else None


def lens_terms(value: Any, where: str, fisheye: bool = False) -> Float[Array, " term"]:
    """Return the terms of a lens as `geometry.distortion` has them, no more than it needs.

    Args:
        value: 0, 4, 5, 8, 12 or 14 numbers in OpenCV's order; for a fisheye 4, or zeros after them.
        where: Begins the messages: file, camera and key.
        fisheye: Of `cv2.fisheye`.
    """
    if isinstance(value, Mapping):
        raise ValueError(f"{where} must be a list k1 k2 p1 p2 k3; got {short(value)}")
    try:
        count = int(np.size(value))
    except ValueError:
        count = -1
    terms = numbers(value, (count,), where) if count else np.zeros(0)
    if fisheye:
        if count < 4 or terms[4:].any():
            raise ValueError(
                f"{where} must hold the 4 terms of a fisheye, k1 k2 k3 k4 of `cv2.fisheye`; got {count}: "
                f"{short(terms.tolist())}"
            )
        return fisheye_lens(terms[:4])
    if count not in (0, 4, 5, 8, 12, FISHEYE_TERM):
        raise ValueError(
            f"{where} must hold 4, 5, 8, 12 or 14 terms, k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y; "
            f"got {count}: {short(terms.tolist())}"
        )
    return shortest_terms(np.pad(terms, (0, FISHEYE_TERM - count)))


def _says_nothing(value: Any) -> bool:
    """Tell null, false, empty and all-zero values."""
    if value is None or value is False or (isinstance(value, str | list | dict) and not value):
        return True
    try:
        return not np.array(value, np.float64).any()
    except (TypeError, ValueError, OverflowError):
        return False
