"""Radial-tangential lens distortion (Brown 1966, in OpenCV's order of coefficients) and its inverse.

Letters: (x, y) an undistorted point of the normalised image plane, r^2 = x^2 + y^2, `dist` = (k1, k2, p1, p2,
k3), or (k1, k2, p1, p2, k3, k4, k5, k6) of OpenCV's rational model, in which the radial factor is divided by
1 + k4 r^2 + k5 r^4 + k6 r^6.
"""

from typing import Any

import numpy as np

from poem_jax.geometry.cameras import normalised_from_pixels, pixels_from_normalised
from poem_jax.typing import Array, Float, array_namespace

_NEWTON_STEPS = 12
_MAX_STEP = 0.5
"""Longest Newton step, in normalised image units, so that a far point is not thrown over the fold of the
lens."""


def distort(
    points_norm: Float[Array, "*#batch point 2"], dist: Float[Array, "*#batch term"]
) -> Float[Array, "*#batch point 2"]:
    """Return where the lens images undistorted normalised points; `dist` has 5 or 8 terms."""
    return _distort_with_jacobian(points_norm, dist)[0]


def undistort(
    points_norm: Float[Array, "*#batch point 2"], dist: Float[Array, "*#batch term"]
) -> Float[Array, "*#batch point 2"]:
    """Invert `distort` by Newton's method with a fixed number of steps, hence differentiable and jit-safe.

    Points beyond the fold of the lens model have no inverse; what comes back for them is finite and means
    nothing.
    """
    xp = array_namespace(points_norm, dist)
    guess = xp.broadcast_to(points_norm, np.broadcast_shapes(points_norm.shape, (*dist.shape[:-1], 1, 2)))
    if xp is not np:
        import jax

        # A loop of the program, not of Python, compiles twelve times less.
        return jax.lax.fori_loop(0, _NEWTON_STEPS, lambda _, g: _newton_step(g, points_norm, dist), guess)
    for _ in range(_NEWTON_STEPS):
        guess = _newton_step(guess, points_norm, dist)
    return guess


def distort_pixels(
    uv_px: Float[Array, "*#batch point 2"],
    K: Float[Array, "*#batch 3 3"],
    dist: Float[Array, "*#batch term"],
    K_new: Float[Array, "*#batch 3 3"] | None = None,
) -> Float[Array, "*#batch point 2"]:
    """Map pixels of an undistorted image with intrinsics `K_new` (None = K) to the raw image of (K, dist)."""
    points_norm = normalised_from_pixels(K if K_new is None else K_new, uv_px)
    return pixels_from_normalised(K, distort(points_norm, dist))


def undistort_pixels(
    uv_px: Float[Array, "*#batch point 2"],
    K: Float[Array, "*#batch 3 3"],
    dist: Float[Array, "*#batch term"],
    K_new: Float[Array, "*#batch 3 3"] | None = None,
) -> Float[Array, "*#batch point 2"]:
    """Map pixels of the raw image of (K, dist) to the undistorted image with intrinsics `K_new` (None =
    K)."""
    points_norm = undistort(normalised_from_pixels(K, uv_px), dist)
    return pixels_from_normalised(K if K_new is None else K_new, points_norm)


def _newton_step(guess: Any, points_norm: Any, dist: Any) -> Any:
    """Return a better guess of the points that the lens images at `points_norm`."""
    xp = array_namespace(guess, points_norm, dist)
    image, (a, b, d) = _distort_with_jacobian(guess, dist)
    error = image - points_norm
    det = a * d - b * b
    det = xp.where(xp.abs(det) < 1e-3, 1e-3, det).astype(error.dtype)
    ex, ey = error[..., 0], error[..., 1]
    step = xp.stack([(d * ex - b * ey) / det, (a * ey - b * ex) / det], axis=-1)
    return guess - xp.clip(step, -_MAX_STEP, _MAX_STEP)


def _distort_with_jacobian(points: Any, dist: Any) -> tuple[Any, tuple[Any, Any, Any]]:
    """Return the distorted points and the entries dx'/dx, dx'/dy = dy'/dx, dy'/dy of the symmetric
    Jacobian."""
    xp = array_namespace(points, dist)
    p1, p2 = dist[..., None, 2], dist[..., None, 3]
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial, slope = _polynomial(r2, dist, (0, 1, 4))
    if dist.shape[-1] == 8:
        below, below_slope = _polynomial(r2, dist, (5, 6, 7))
        radial = radial / below
        slope = (slope - radial * below_slope) / below
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    du_dx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    du_dy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    dv_dy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return xp.stack([u, v], axis=-1), (du_dx, du_dy, dv_dy)


def _polynomial(r2: Any, dist: Any, terms: tuple[int, int, int]) -> tuple[Any, Any]:
    """Return 1 + a r^2 + b r^4 + c r^6 and twice its derivative with respect to r^2; a, b, c by index."""
    a, b, c = (dist[..., None, term] for term in terms)
    return 1 + r2 * (a + r2 * (b + r2 * c)), 2 * (a + r2 * (2 * b + 3 * r2 * c))
