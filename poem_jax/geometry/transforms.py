"""Rigid transforms and rotations that follow the type of their arrays (NumPy in, NumPy out; JAX in, JAX out).

Letters: `T_a_from_b` (*batch, 4, 4) maps points of frame b to frame a and composes by adjacent names,
`T_a_from_c = T_a_from_b @ T_b_from_c`. `R` is its rotation, `t` its offset in metres, `v` an axis-angle
vector in radians, `q` a quaternion wxyz. Points are rows, (*batch, point, 3).

At singular points (zero rotation, half turns, parallel 6D vectors) a safe value is chosen before the risky
operation, so that values and gradients stay finite.
"""

from typing import Any

import numpy as np

from poem_jax.typing import Array, Float, array_namespace

_SMALL_ANGLE_SQUARED = 1e-4
"""Below it series replace quotients; their error, about angle^6 / 5040, is under float64's resolution."""


def matmul(a: Array, b: Array) -> Array:
    """Multiply matrices (*#batch, i, j) and (*#batch, j, k) at full precision.

    Accelerators multiply float32 matrices in fewer bits by default; at 10 bits a pixel is lost in every 1000.
    """
    xp = array_namespace(a, b)
    return xp.matmul(a, b) if xp is np else xp.matmul(a, b, precision="highest")


def transpose(matrix: Float[Array, "*batch i j"]) -> Float[Array, "*batch j i"]:
    """Swap the last two axes."""
    return array_namespace(matrix).swapaxes(matrix, -1, -2)


def rigid(
    R_a_from_b: Float[Array, "*batch 3 3"], t_a_from_b: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 4 4"]:
    """Assemble `T_a_from_b` from its rotation and its offset in metres."""
    xp = array_namespace(R_a_from_b, t_a_from_b)
    upper = xp.concatenate([R_a_from_b, t_a_from_b[..., None]], axis=-1)
    lower = xp.broadcast_to(xp.asarray([[0, 0, 0, 1]], dtype=upper.dtype), (*upper.shape[:-2], 1, 4))
    return xp.concatenate([upper, lower], axis=-2)


def invert_rigid(T_a_from_b: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """Return `T_b_from_a`, using R^-1 = R^T; the matrix must be rigid."""
    R_b_from_a = transpose(T_a_from_b[..., :3, :3])
    return rigid(R_b_from_a, -matmul(R_b_from_a, T_a_from_b[..., :3, 3:])[..., 0])


def transform_points(
    T_a_from_b: Float[Array, "*#batch 4 4"], points_b: Float[Array, "*#batch point 3"]
) -> Float[Array, "*#batch point 3"]:
    """Map points of frame b to frame a; leading axes broadcast."""
    return rotate_points(T_a_from_b[..., :3, :3], points_b) + T_a_from_b[..., None, :3, 3]


def rotate_points(
    R_a_from_b: Float[Array, "*#batch 3 3"], points_b: Float[Array, "*#batch point 3"]
) -> Float[Array, "*#batch point 3"]:
    """Turn points (or directions) of frame b into frame a; leading axes broadcast."""
    return matmul(points_b, transpose(R_a_from_b))


def skew_matrix(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Return [v]x, the matrix of the cross product: [v]x w = v x w."""
    xp = array_namespace(v)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = xp.zeros_like(x)
    return _matrix(xp, [[o, -z, y], [z, o, -x], [-y, x, o]])


def rotation_about_z(angle: Float[Array, "*batch"] | float) -> Float[Array, "*batch 3 3"]:
    """Return Rot(a), which turns the x axis towards the y axis; radians.

    Seen through an OpenCV camera (y down) a positive angle turns the image clockwise.
    """
    xp = array_namespace(angle)
    angle = xp.asarray(angle)
    c, s = xp.cos(angle), xp.sin(angle)
    o, i = xp.zeros_like(c), xp.ones_like(c)
    return _matrix(xp, [[c, -s, o], [s, c, o], [o, o, i]])


def rotation_from_axis_angle(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Rodrigues' formula, R = I + sin(a)/a [v]x + (1 - cos a)/a^2 [v]x^2 with a = |v| in radians."""
    xp = array_namespace(v)
    a2 = xp.sum(v * v, axis=-1)
    small = a2 < _SMALL_ANGLE_SQUARED
    half = 0.5 * xp.sqrt(xp.where(small, xp.ones_like(a2), a2))
    sine = xp.where(small, 1 - a2 / 6 + a2 * a2 / 120, xp.sin(2 * half) / (2 * half))
    # 2 sin^2(a/2) instead of 1 - cos(a), which cancels in float32.
    cosine = xp.where(small, 0.5 - a2 / 24 + a2 * a2 / 720, 0.5 * (xp.sin(half) / half) ** 2)
    # [v]x^2 = v v^T - |v|^2 I.
    square = v[..., :, None] * v[..., None, :] - a2[..., None, None] * xp.eye(3, dtype=v.dtype)
    first = sine[..., None, None] * skew_matrix(v)
    return xp.eye(3, dtype=v.dtype) + first + cosine[..., None, None] * square


def axis_angle_from_rotation(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Return the axis-angle vector with angle in [0, pi]; at exactly pi either axis direction may come
    back."""
    xp = array_namespace(R)
    q = quaternion_from_rotation(R)
    w, v = q[..., :1], q[..., 1:]
    n2 = xp.sum(v * v, axis=-1, keepdims=True)
    small = n2 < _SMALL_ANGLE_SQUARED
    n = xp.sqrt(xp.where(small, xp.ones_like(n2), n2))
    # atan(n/w)/n as a series in (n/w)^2; w is close to 1 here. Elsewhere w may be 0.
    w_safe = xp.where(small, w, xp.ones_like(w))
    r2 = xp.where(small, n2, xp.zeros_like(n2)) / (w_safe * w_safe)
    series = (1 - r2 / 3 + r2 * r2 / 5 - r2 * r2 * r2 / 7) / w_safe
    return 2 * v * xp.where(small, series, xp.arctan2(n, w) / n)


def quaternion_from_rotation(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 4"]:
    """Return the unit quaternion wxyz with w >= 0.

    Each row of the symmetric matrix 4 q q^T is a multiple of q; the row with the largest diagonal entry,
    which is at least 1, is well conditioned everywhere (Shepperd 1978).
    """
    xp = array_namespace(R)
    m = [[R[..., i, j] for j in range(3)] for i in range(3)]
    x, y, z = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    ww = 1 + m[0][0] + m[1][1] + m[2][2]
    xx = 1 + m[0][0] - m[1][1] - m[2][2]
    yy = 1 - m[0][0] + m[1][1] - m[2][2]
    zz = 1 - m[0][0] - m[1][1] + m[2][2]
    rows = _matrix(xp, [[ww, x, y, z], [x, xx, xy, xz], [y, xy, yy, yz], [z, xz, yz, zz]])
    best = xp.argmax(xp.stack([ww, xx, yy, zz], axis=-1), axis=-1)
    q = xp.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = unit_vectors(q)
    return xp.where(q[..., :1] < 0, -q, q)


def smallest_rotation(
    a: Float[Array, "*#batch 3"], b: Float[Array, "*#batch 3"]
) -> Float[Array, "*batch 3 3"]:
    """Return the rotation about a x b that turns the direction of `a` to that of `b`, vectors of any length.

    R = I + [c]x + [c]x^2 / (1 + cos), c = a x b (Rodrigues). Not a rotation where 1 + cos < 0.01 (within 8
    degrees of opposite, where the axis is undetermined), but finite, as for vectors of length zero.
    """
    xp = array_namespace(a, b)
    a, b = unit_vectors(a), unit_vectors(b)
    cross = skew_matrix(xp.cross(a, b))
    cosine = xp.sum(a * b, axis=-1)[..., None, None]
    return xp.eye(3, dtype=cross.dtype) + cross + matmul(cross, cross) / xp.maximum(1 + cosine, 1e-2)


def unit_vectors(v: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """Scale vectors to length 1; a vector of length zero stays, with a finite gradient."""
    xp = array_namespace(v)
    n2 = xp.sum(v * v, axis=-1, keepdims=True)
    return v / xp.sqrt(xp.where(n2 > 0, n2, xp.ones_like(n2)))


def rotation_from_6d(x: Float[Array, "*batch 6"]) -> Float[Array, "*batch 3 3"]:
    """Orthonormalise two 3-vectors into the first two ROWS of a rotation (Zhou et al. 2019; released
    POEM-v2).

    b1 = a / |a|, b2 = normalised(b - <b1, b> b1), b3 = b1 x b2. A vanishing `a` counts as the x axis, and a
    `b` parallel to `a` as some perpendicular axis, both with zero gradient.
    """
    xp = array_namespace(x)
    tiny = float(xp.finfo(x.dtype).eps) ** 2
    b1 = _normalise(xp, x[..., :3], xp.asarray([1, 0, 0], dtype=x.dtype), 1e-30)
    b = x[..., 3:]
    perpendicular = b - xp.sum(b1 * b, axis=-1, keepdims=True) * b1
    limit = 64 * tiny * xp.sum(b * b, axis=-1, keepdims=True) + 1e-30
    b2 = _normalise(xp, perpendicular, _some_perpendicular(xp, b1), limit)
    return xp.stack([b1, b2, xp.cross(b1, b2)], axis=-2)


def sixd_from_rotation(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 6"]:
    """Return the first two rows of R, the inverse of `rotation_from_6d`."""
    return R[..., :2, :].reshape(*R.shape[:-2], 6)


def _normalise(xp: Any, v: Array, fallback: Array, min_square: Any) -> Array:
    """Scale `v` to length 1, or take the unit vector `fallback` where |v|^2 <= min_square."""
    n2 = xp.sum(v * v, axis=-1, keepdims=True)
    degenerate = n2 <= min_square
    return xp.where(degenerate, fallback, v / xp.sqrt(xp.where(degenerate, xp.ones_like(n2), n2)))


def _some_perpendicular(xp: Any, b1: Array) -> Array:
    """Return a unit vector perpendicular to the unit vector `b1`: the axis farthest from it, made
    orthogonal."""
    axis = xp.eye(3, dtype=b1.dtype)[xp.argmin(xp.abs(b1), axis=-1)]
    v = axis - xp.sum(b1 * axis, axis=-1, keepdims=True) * b1
    return unit_vectors(v)


def _matrix(xp: Any, rows: list[list[Array]]) -> Array:
    """Stack entries of shape (*batch,) into (*batch, row, column)."""
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
