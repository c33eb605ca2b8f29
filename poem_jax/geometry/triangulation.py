"""Masked, weighted direct linear transform (DLT) for any number of points and views.

Letters: M = K [R|t] (3, 4) per view; A (2 v, 4) stacks the rows u M_2 - M_0 and v M_2 - M_1 of all views; the
point is the right singular vector x of A's smallest singular value, divided by its fourth component (Hartley
and Zisserman, Multiple View Geometry, section 12.2). The SVD of A, not eigenvectors of A^T A, keeps float32
useful down to baselines of 0.1 mm.
"""

import jax
import jax.numpy as jnp

from poem_jax.geometry.singular_values import svd
from poem_jax.geometry.transforms import invert_rigid, matmul, unit_vectors
from poem_jax.typing import Array, Bool, Float

MIN_BASELINE = 1e-5
"""Metres. Cameras closer together than this count as one."""

_RELEASE_EPSILON = 1e-7
"""Added to the fourth component by the release."""


def triangulate(
    uv_px: Float[Array, "*batch view point 2"],
    K: Float[Array, "*batch view 3 3"],
    T_cam_from_world: Float[Array, "*batch view 4 4"],
    weights: Float[Array, "*batch view point"] | None = None,
    mask: Bool[Array, "*batch view point"] | None = None,
    *,
    normalise_rows: bool = True,
) -> tuple[Float[Array, "*batch point 3"], Bool[Array, "*batch point"]]:
    """Return the points that best explain their pixels in all views.

    Args:
        uv_px: pixels; non-finite ones are ignored.
        K: intrinsics of the images in which `uv_px` is measured.
        T_cam_from_world: extrinsics, metres.
        weights: factor of the two rows of a view; zero means "ignore"; None means 1.
        mask: False means "ignore", whatever the masked entries of the other arguments hold; None means all
        True.
        normalise_rows: scale each row of A to unit norm and divide by the fourth component (paper presets);
        False
            keeps the release's raw pixel rows and its division by (fourth component + 1e-7).

    Returns: points in metres in the world frame, and `valid`. A point with fewer than two usable views, or
    whose cameras do not determine it (same centre, point at infinity or on the baseline), is zero with zero
    gradient, and `valid` is False.
    """
    usable = _usable(uv_px, weights, mask)
    rows = _rows(jnp.where(usable[..., None], uv_px, 0), _projections(K, T_cam_from_world, usable))
    if normalise_rows:
        rows = unit_vectors(rows)
    rows = rows * (usable if weights is None else jnp.where(usable, weights, 0))[..., None, None]
    well_posed = (jnp.sum(usable, axis=-2) >= 2) & _has_baseline(T_cam_from_world, usable)
    x, singular = null_vector(_safe_system(rows, well_posed))
    # The sign is free, but the release's epsilon is not symmetric: keep the result continuous.
    x = jnp.where(x[..., 3:] < 0, -x, x)
    determined = singular[..., 2] > 8 * jnp.finfo(x.dtype).eps * singular[..., 0]
    valid = well_posed & determined & (x[..., 3] > 8 * jnp.finfo(x.dtype).eps)
    fourth = x[..., 3:] + (0 if normalise_rows else _RELEASE_EPSILON)
    points = jnp.where(valid[..., None], x[..., :3], 0) / jnp.where(valid[..., None], fourth, 1)
    return points, valid


@jax.custom_jvp
def null_vector(
    A: Float[Array, "*batch row 4"],
) -> tuple[Float[Array, "*batch 4"], Float[Array, "*batch 4"]]:
    """Return the right singular vector of the smallest singular value, and all four, largest first.

    A must have at least 4 rows. The vector's sign is arbitrary. Its derivative is that of an eigenvector of
    A^T A, written with A = U S V^T so that nothing is squared: only the gaps to the smallest singular value
    s_4 enter, dx = sum_i v_i (s_4 u_4 . dA v_i + s_i u_i . dA x) / (s_4^2 - s_i^2), i < 4; where a gap
    vanishes the term is dropped, so that the derivative is finite always. First derivatives only.
    """
    _, singular, Vt = svd(A)
    return Vt[..., 3, :], singular


@null_vector.defjvp
def _null_vector_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple, tuple]:
    (A,), (dA,) = primals, tangents
    U, s, Vt = svd(A)
    u4, s4, x = U[..., :, 3:], s[..., 3:], Vt[..., 3, :]
    left = matmul(jnp.swapaxes(U, -1, -2), matmul(dA, x[..., None]))[..., 0]
    right = matmul(matmul(Vt, jnp.swapaxes(dA, -1, -2)), u4)[..., 0]
    gap = (s4 - s[..., :3]) * (s4 + s[..., :3])
    eps = jnp.finfo(s.dtype).eps
    open_gap = -gap > (eps * s[..., :1]) ** 2
    numerator = s4 * right[..., :3] + s[..., :3] * left[..., :3]
    coefficient = jnp.where(open_gap, numerator, 0) / jnp.where(open_gap, gap, 1)
    dx = matmul(coefficient[..., None, :], Vt[..., :3, :])[..., 0, :]
    ds = jnp.sum(U * matmul(dA, jnp.swapaxes(Vt, -1, -2)), axis=-2)
    return (x, s), (dx, ds)


def _usable(uv_px: Array, weights: Array | None, mask: Array | None) -> Bool[Array, "*batch view point"]:
    usable = jnp.all(jnp.isfinite(uv_px), axis=-1)
    if mask is not None:
        usable = usable & mask
    if weights is not None:
        usable = usable & (weights > 0)
    return usable


def _projections(K: Array, T_cam_from_world: Array, usable: Array) -> Float[Array, "*batch view 3 4"]:
    """Return M = K [R|t]; views that no point uses may hold anything and get zeros."""
    seen = jnp.any(usable, axis=-1)[..., None, None]
    return matmul(jnp.where(seen, K, 0), jnp.where(seen, T_cam_from_world, 0)[..., :3, :])


def _rows(uv_px: Array, M: Array) -> Float[Array, "*batch view point 2 4"]:
    """Return u M_2 - M_0 and v M_2 - M_1."""
    return uv_px[..., None] * M[..., None, 2:, :] - M[..., None, :2, :]


def _has_baseline(T_cam_from_world: Array, usable: Array) -> Bool[Array, "*batch point"]:
    """Tell whether two usable cameras are more than about `MIN_BASELINE` apart."""
    seen = jnp.any(usable, axis=-1)[..., None, None]
    T = jax.lax.stop_gradient(jnp.where(seen, T_cam_from_world, 0))
    centres = invert_rigid(T)[..., None, :3, 3]
    used = usable[..., None]
    high = jnp.max(jnp.where(used, centres, -jnp.inf), axis=-3)
    low = jnp.min(jnp.where(used, centres, jnp.inf), axis=-3)
    return jnp.any(high - low > MIN_BASELINE, axis=-1)


def _safe_system(rows: Array, well_posed: Array) -> Float[Array, "*batch point row 4"]:
    """Stack all views' rows per point, at least 4; ill-posed points get diag(4, 3, 2, 1), whose answer is
    0."""
    A = jnp.moveaxis(rows, -4, -3)
    A = A.reshape(*A.shape[:-3], -1, 4)
    missing = max(0, 4 - A.shape[-2])
    A = jnp.pad(A, [(0, 0)] * (A.ndim - 2) + [(0, missing), (0, 0)])
    safe = jnp.zeros(A.shape[-2:], A.dtype).at[:4].set(jnp.diag(jnp.asarray([4, 3, 2, 1], A.dtype)))
    return jnp.where(well_posed[..., None, None], A, safe)
