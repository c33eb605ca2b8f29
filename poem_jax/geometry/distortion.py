"""Lenses: where they image the rays of a camera, and the inverse; OpenCV's two families of models.

Letters: (x, y) an undistorted point of the normalised image plane, r^2 = x^2 + y^2. A lens is a row of terms
`dist`, and what the terms are follows from how many there are:

- 5: k1 k2 p1 p2 k3, radial and tangential (Brown 1966).
- 8: and k4 k5 k6, the rational model: the radial factor is divided by 1 + k4 r^2 + k5 r^4 + k6 r^6.
- 12: and s1 s2 s3 s4 of thin prisms. 14: and tau_x tau_y, radians, by which the sensor is tilted.
- 15: as 14, and a last one that tells the family. 0: those 14 terms. 1: a fisheye (Kannala and Brandt 2006,
  `cv2.fisheye`), whose k1 k2 k3 k4 stand first and zeros after them: a ray at the angle theta to the axis is
  imaged at theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) from the centre.

So the lenses of a rig fill one array, whichever they are (`stack_lenses`), and zeros are no lens. A fisheye
may see rays that no plane in front of it meets, or far out alone: those beyond `WIDEST_ANGLE` count as not
shown, which `undistort` tells by a ray that `distort` does not bring back.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from poem_jax.geometry.cameras import normalised_from_pixels, pixels_from_normalised
from poem_jax.typing import Array, Bool, Float, array_namespace

FISHEYE_TERM = 14
"""Index of the term that tells a fisheye, where there are 15."""
TERM_COUNTS = (5, 8, 12, FISHEYE_TERM, FISHEYE_TERM + 1)
"""How many terms a lens may have."""
WIDEST_ANGLE = float(np.radians(85))
"""Radians from the axis of a fisheye. At it a pixel of the sensor is 130 in a flat picture."""
_NEWTON_STEPS = 12
_MAX_STEP = 0.5
"""Longest Newton step, in normalised image units, so that a far point is not thrown over the fold of the
lens."""


def fisheye_lens(terms: Float[Array, "4"]) -> Float[Array, "15"]:
    """Return the row of a fisheye with the terms k1 k2 k3 k4 of `cv2.fisheye`."""
    lens = np.zeros(FISHEYE_TERM + 1)
    lens[:4], lens[FISHEYE_TERM] = terms, 1
    return lens


def stack_lenses(lenses: Sequence[Float[Array, " _"]]) -> Float[Array, "view term"]:
    """Return the rows of several lenses as one array, the shorter ones filled up with zeros."""
    terms = max(map(len, lenses))
    return np.stack([np.pad(np.asarray(lens, np.float64), (0, terms - len(lens))) for lens in lenses])


def is_fisheye(dist: Float[Array, "*batch term"]) -> Bool[Array, "*batch"]:
    """Tell which lenses are fisheyes."""
    if dist.shape[-1] <= FISHEYE_TERM:
        return np.zeros(dist.shape[:-1], bool)
    return dist[..., FISHEYE_TERM] > 0.5


def shortest_terms(dist: Float[Array, " term"]) -> Float[Array, " short"]:
    """Return the terms of one lens as calibration tools write them.

    Those of a fisheye are its 4; of a pinhole the last ones that are zero are left out, so that 5, 8, 12 or
    14 remain.
    """
    if is_fisheye(dist):
        return dist[:4]
    return next(dist[:count] for count in TERM_COUNTS if not dist[count:].any())


def distort(
    points_norm: Float[Array, "*#batch point 2"], dist: Float[Array, "*#batch term"]
) -> Float[Array, "*#batch point 2"]:
    """Return where the lens images undistorted normalised points."""
    return _of_its_family(_distort_pinhole, _distort_fisheye, points_norm, dist)


def undistort(
    points_norm: Float[Array, "*#batch point 2"], dist: Float[Array, "*#batch term"]
) -> Float[Array, "*#batch point 2"]:
    """Invert `distort` by Newton's method with a fixed number of steps, hence differentiable and jit-safe.

    Points beyond the fold of the lens model, or beyond `WIDEST_ANGLE` of a fisheye, have no inverse; what
    comes back for them is finite and means nothing.
    """
    return _of_its_family(_undistort_pinhole, _undistort_fisheye, points_norm, dist)


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


def _of_its_family(pinhole: Any, fisheye: Any, points: Any, dist: Any) -> Any:
    """Apply the function of each lens's own family; of NumPy arrays only those that occur are computed."""
    if dist.shape[-1] <= FISHEYE_TERM:
        return pinhole(points, dist)
    xp = array_namespace(points, dist)
    fish = is_fisheye(dist)
    if xp is np and not fish.any():
        return pinhole(points, dist[..., :FISHEYE_TERM])
    if xp is np and fish.all():
        return fisheye(points, dist)
    # The terms of the other family are zeros, so that what is not chosen stays finite, as do its gradients.
    of_pinhole = xp.where(fish[..., None], 0, dist[..., :FISHEYE_TERM])
    of_fisheye = xp.where(fish[..., None], dist[..., :4], 0)
    return xp.where(fish[..., None, None], fisheye(points, of_fisheye), pinhole(points, of_pinhole))


def _distort_fisheye(points: Any, dist: Any) -> Any:
    xp = array_namespace(points, dist)
    square = xp.sum(points * points, -1, keepdims=True)
    central = square < 1e-12
    radius = xp.sqrt(xp.where(central, 1, square))
    factor = xp.where(central, 1, _fisheye_radius(xp.arctan(radius), dist)[0] / radius)
    return points * factor


def _undistort_fisheye(points: Any, dist: Any) -> Any:
    xp = array_namespace(points, dist)
    square = xp.sum(points * points, -1, keepdims=True)
    central = square < 1e-12
    radius = xp.sqrt(xp.where(central, 1, square))

    def step(theta: Any) -> Any:
        image, slope = _fisheye_radius(theta, dist)
        slope = xp.where(xp.abs(slope) < 1e-3, 1e-3, slope).astype(image.dtype)
        change = xp.clip((image - radius) / slope, -_MAX_STEP, _MAX_STEP)
        return xp.clip(theta - change, 0, WIDEST_ANGLE).astype(image.dtype)

    shape = np.broadcast_shapes(radius.shape, (*dist.shape[:-1], 1, 1))
    theta = _newton(step, xp.broadcast_to(xp.clip(radius, 0, WIDEST_ANGLE), shape))
    return points * xp.where(central, 1, xp.tan(theta) / radius)


def _fisheye_radius(theta: Any, dist: Any) -> tuple[Any, Any]:
    """Return how far from the centre a ray at the angle theta (*batch, point, 1) is imaged, and the slope."""
    k1, k2, k3, k4 = (dist[..., None, None, term] for term in range(4))
    t2 = theta * theta
    image = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return image, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


def _distort_pinhole(points: Any, dist: Any) -> Any:
    image = _distort_with_jacobian(points, dist)[0]
    return image if dist.shape[-1] < FISHEYE_TERM else _through(_tilt(dist), image)


def _undistort_pinhole(points_norm: Any, dist: Any) -> Any:
    xp = array_namespace(points_norm, dist)
    if dist.shape[-1] == FISHEYE_TERM:
        points_norm = _through(xp.linalg.inv(_tilt(dist)), points_norm)
    shape = np.broadcast_shapes(points_norm.shape, (*dist.shape[:-1], 1, 2))
    return _newton(lambda guess: _newton_step(guess, points_norm, dist), xp.broadcast_to(points_norm, shape))


def _newton(step: Any, start: Any) -> Any:
    """Take a fixed number of steps; a loop of the program, not of Python, compiles twelve times less."""
    if array_namespace(start) is not np:
        import jax

        return jax.lax.fori_loop(0, _NEWTON_STEPS, lambda _, guess: step(guess), start)
    for _ in range(_NEWTON_STEPS):
        start = step(start)
    return start


def _newton_step(guess: Any, points_norm: Any, dist: Any) -> Any:
    """Return a better guess of the points that the lens images at `points_norm`."""
    xp = array_namespace(guess, points_norm, dist)
    image, (a, b, c, d) = _distort_with_jacobian(guess, dist)
    error = image - points_norm
    det = a * d - b * c
    det = xp.where(xp.abs(det) < 1e-3, 1e-3, det).astype(error.dtype)
    ex, ey = error[..., 0], error[..., 1]
    step = xp.stack([(d * ex - b * ey) / det, (a * ey - c * ex) / det], axis=-1)
    return guess - xp.clip(step, -_MAX_STEP, _MAX_STEP)


def _distort_with_jacobian(points: Any, dist: Any) -> tuple[Any, tuple[Any, Any, Any, Any]]:
    """Return the points distorted, but for the tilt, and dx'/dx, dx'/dy, dy'/dx, dy'/dy of the Jacobian."""
    xp = array_namespace(points, dist)
    p1, p2 = dist[..., None, 2], dist[..., None, 3]
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial, slope = _polynomial(r2, dist, (0, 1, 4))
    if dist.shape[-1] >= 8:
        below, below_slope = _polynomial(r2, dist, (5, 6, 7))
        radial = radial / below
        slope = (slope - radial * below_slope) / below
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    du_dx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    du_dy = dv_dx = slope * x * y + 2 * p1 * x + 2 * p2 * y
    dv_dy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    if dist.shape[-1] >= 12:
        s1, s2, s3, s4 = (dist[..., None, term] for term in range(8, 12))
        u, v = u + r2 * (s1 + s2 * r2), v + r2 * (s3 + s4 * r2)
        across, along = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
        du_dx, du_dy = du_dx + across * x, du_dy + across * y
        dv_dx, dv_dy = dv_dx + along * x, dv_dy + along * y
    return xp.stack([u, v], axis=-1), (du_dx, du_dy, dv_dx, dv_dy)


def _polynomial(r2: Any, dist: Any, terms: tuple[int, int, int]) -> tuple[Any, Any]:
    """Return 1 + a r^2 + b r^4 + c r^6 and twice its derivative with respect to r^2; a, b, c by index."""
    a, b, c = (dist[..., None, term] for term in terms)
    return 1 + r2 * (a + r2 * (b + r2 * c)), 2 * (a + r2 * (2 * b + 3 * r2 * c))


def _tilt(dist: Any) -> Any:
    """Return the homography (*batch, 3, 3) of a sensor that is tilted by tau_x, then by tau_y.

    With R = R_y(tau_y) R_x(tau_x), the sensor's axes, it is [[R33, 0, -R13], [0, R33, -R23], [0, 0, 1]] R
    (Louhichi et al. 2007).
    """
    xp = array_namespace(dist)
    (cx, sx), (cy, sy) = ((xp.cos(dist[..., i]), xp.sin(dist[..., i])) for i in (12, 13))
    r13, r23, r33 = -sy * cx, sx, cy * cx
    none = xp.zeros_like(r33)
    rows = [
        [r33 * cy - r13 * sy, r33 * sy * sx + r13 * cy * sx, none],
        [-r23 * sy, r33 * cx + r23 * cy * sx, none],
        [sy, -cy * sx, r33],
    ]
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def _through(H: Any, points: Any) -> Any:
    """Apply a homography (*batch, 3, 3), row by row."""
    xp = array_namespace(H, points)
    x, y = points[..., 0], points[..., 1]
    u, v, w = (H[..., None, i, 0] * x + H[..., None, i, 1] * y + H[..., None, i, 2] for i in range(3))
    return xp.stack([u / w, v / w], -1)
