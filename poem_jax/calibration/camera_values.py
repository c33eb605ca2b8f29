"""The numbers of one camera as calibration files hold them, checked value by value.

Each function takes the value as a parser gives it (lists, numbers, text), and `where`, the file and camera
that a message begins with. A value whose meaning can be guessed but not known, as a rotation vector in place
of a matrix, is refused with what to do; one that has a single meaning, as `t` as a column, is read.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from poem_jax.geometry.camera_checks import ROTATION_TOLERANCE, has_form_of_intrinsics, rotation_error
from poem_jax.typing import Array, Float

MAX_SIDE = 100_000
"""Pixels. No image is wider or higher."""


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


def text(value: Any, where: str) -> str:
    """Return text; a whole number, as tools name cameras too, becomes its digits."""
    if isinstance(value, str) or (isinstance(value, int) and not isinstance(value, bool)):
        return str(value)
    raise ValueError(f"{where} must be text; got {short(value)}")


def number(value: Any, where: str) -> float:
    """Return a finite real number."""
    return float(numbers([value], (1,), where)[0])


def image_size(width: Any, height: Any, where: str) -> tuple[int, int]:
    """Return width and height as whole pixels; 1280.0 is 1280."""
    if not all(_is_whole(side) and 0 < side <= MAX_SIDE for side in (width, height)):
        raise ValueError(
            f"{where}: width and height must be whole pixels, 1 to {MAX_SIDE}; got {short(width)} x "
            f"{short(height)}"
        )
    return int(width), int(height)


def image_size_of(sides: Sequence[Any], where: str) -> tuple[int, int]:
    """Return a list of width and height as whole pixels."""
    width, height = sides
    return image_size(width, height, where)


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


def rotation_or_vector(value: Any, where: str) -> Float[Array, "3 3"]:
    """Return R from a rotation matrix, or from a rotation vector (axis times angle, radians)."""
    if _shape(value) in ((3,), (3, 1), (1, 3)):
        return rotation_of_vector(numbers(value, (3,), f"{where}: the rotation vector"))
    return rotation(value, where)


def rotation_of_vector(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the matrix of a rotation vector, as `cv2.Rodrigues` in both directions, in double precision."""
    return Rotation.from_rotvec(np.asarray(vector, np.float64)).as_matrix()


def vector_of_rotation(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the rotation vector of a matrix."""
    return Rotation.from_matrix(R).as_rotvec()


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


def entry(content: Any, key: str, where: str) -> Any:
    """Return the value under a key of a map.

    Raises: ValueError: there is no such key, or no map.
    """
    if not isinstance(content, Mapping):
        raise ValueError(f"{where} must hold `{key}` and others by name; got {short(content)}")
    if key not in content:
        found = ", ".join(str(name)[:40] for name in list(content)[:20]) or "nothing"
        raise ValueError(f"{where}: `{key}` is missing; found {found}")
    return content[key]


def short(value: Any) -> str:
    """Return a value as a message shows it."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value == value // 1


def _holds_bool(value: Any) -> bool:
    return any(map(_holds_bool, value)) if isinstance(value, list | tuple) else isinstance(value, bool)


def _shape(value: Any) -> tuple[int, ...] | None:
    try:
        return np.shape(value)
    except ValueError:
        return None
