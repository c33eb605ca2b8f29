"""Robust triangulation: which views agree on a joint, where it is, and how far that can be trusted.

For every joint each pair of views proposes a point (the middle of the shortest segment between its two rays)
and the weighted DLT of all views proposes one more; all views vote on every proposal by their truncated
reprojection error. The views that agree with the winner are its inliers, and Gauss-Newton steps on their
reprojection error refine it. With few cameras this search is exhaustive: no random samples.

Letters: r = reprojection residual (px); J = d r / d point (2 v, 3); w = confidence of a view; s = noise of
one coordinate of a key point of confidence 1 (px), estimated from the residuals of a whole take with a
scaled inverse chi-square prior: first from their median, then from those of the views that agree. The
covariance of a joint is s^2 (sum_v w J_v^T J_v)^-1.
"""

import math
from dataclasses import dataclass, fields
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.geometry.cameras import normalised_from_pixels, project
from poem_jax.geometry.transforms import invert_rigid, rotate_points, transform_points
from poem_jax.geometry.triangulation import triangulate
from poem_jax.typing import Array, Bool, Float, Num

REFERENCE_DIAGONAL_PX = math.hypot(1280, 720)
"""Of the images that defaults in pixels are meant for."""

_STEPS = 4
_FEWEST_VIEWS = 2
_DAMPING = 1e-6
_PARALLEL = 1e-7
"""Squared sine of the angle between two rays below which they count as parallel."""
_GATE_SIGMAS = 4.5
"""A view further off than this many times the noise never agrees, once the noise is known."""
_EXPECTED_COUNT = 20.0
"""The noise is as if this many residuals of the expected size had been seen before."""


@dataclass(frozen=True)
class KeypointNoise:
    """What to expect of the key points, in pixels; the defaults suit images of 1280 x 720."""

    gate_px: float = 20.0
    """A view further off than this from where the others see a joint is an outlier."""
    expected_px: float = 1.5
    """Noise of one coordinate, before any was seen."""
    least_px: float = 0.3
    """Nobody is taken to be better than this."""

    @classmethod
    def of_images(cls, size_wh: Num[Array, "*view 2"]) -> "KeypointNoise":
        """Scale the defaults to images of this size (of several cameras: their mean diagonal)."""
        scale = float(np.mean(np.linalg.norm(np.asarray(size_wh, float), axis=-1))) / REFERENCE_DIAGONAL_PX
        return cls(*(scale * getattr(cls(), field.name) for field in fields(cls)))


class RobustPoints(NamedTuple):
    """Triangulated joints with their uncertainty."""

    points: Float[Array, "*batch joint 3"]
    """Metres, world frame; zero where not `valid`."""
    valid: Bool[Array, "*batch joint"]
    """False where fewer than two views agree."""
    covariance: Float[Array, "*batch joint 3 3"]
    """Square metres; zero where not `valid`."""
    sigma_m: Float[Array, "*batch joint"]
    """Standard deviation of one coordinate, sqrt(trace(covariance) / 3), metres; zero where not `valid`."""
    inlier_mask: Bool[Array, "*batch view joint"]
    """The views that agree on the joint; all False where not `valid`."""
    sigma_px: Float[Array, "*batch"]
    """Estimated noise of one coordinate of a key point of confidence 1, pixels."""


def triangulate_robust(
    uv_px: Float[Array, "..."],
    K: Float[Array, "..."],
    T_cam_from_world: Float[Array, "..."],
    confidence: Float[Array, "..."] | None = None,
    mask: Bool[Array, "..."] | None = None,
    *,
    noise: KeypointNoise = KeypointNoise(),
    take_axis: int | None = None,
) -> RobustPoints:
    """Triangulate joints from the views that agree with each other.

    Args:
        uv_px: key points (*batch, view, joint, 2); non-finite ones are ignored.
        K: (*batch, view, 3, 3) of the images in which `uv_px` is measured; its batch axes broadcast.
        T_cam_from_world: (*batch, view, 4, 4), metres; likewise.
        confidence: inverse variance of each key point (*batch, view, joint), on any scale; zero, negative or
            NaN means "ignore".
        mask: (*batch, view, joint); False means "ignore", whatever the other arguments hold there.
        noise: what to expect of the key points; static under `jax.jit`.
        take_axis: batch axis (say, of frames) over which the noise is estimated together; None estimates it
            for each batch entry from its own joints.

    Returns: see `RobustPoints`. Differentiable with respect to the pixels, the cameras and the confidence at
    fixed inliers.

    Raises:
        ValueError: fewer than two views, or key points and cameras of different numbers of views.
    """
    uv, weights, K, T = _clean_inputs(uv_px, K, T_cam_from_world, confidence, mask, take_axis)
    start, inliers = _vote(uv, weights, K, T, noise.gate_px)
    points = _refine(start, uv, weights * inliers, K, T)
    sigma = _noise(*_residuals(points, uv, weights * inliers, K, T), take_axis, noise, by_median=True)
    inliers = _agreeing(points, uv, weights, K, T, _GATE_SIGMAS * sigma, noise.gate_px)
    inliers = inliers & (jnp.sum(inliers, -2, keepdims=True) >= _FEWEST_VIEWS)
    used = weights * inliers
    points = _refine(points, uv, used, K, T)
    sigma = _noise(*_residuals(points, uv, used, K, T), take_axis, noise, by_median=False)
    return _with_uncertainty(points, uv, used, K, T, sigma)


def relative_confidence(
    confidence: Float[Array, "*batch view joint"],
    usable: Bool[Array, "*batch view joint"],
    take_axis: int | None,
) -> Float[Array, "*batch view joint"]:
    """Return confidences scaled to a mean of 1 over the usable key points of a take; zero elsewhere."""
    axes = (-2, -1) if take_axis is None else (take_axis, -2, -1)
    kept = jnp.where(usable, confidence, 0)
    total, count = (jnp.sum(x, axis=axes, keepdims=True) for x in (kept, usable))
    return kept * count / jnp.where(total > 0, total, 1)


def usable_keypoints(
    uv_px: Float[Array, "*batch view joint 2"],
    cameras_known: Bool[Array, "*batch view"],
    confidence: Float[Array, "*batch view joint"] | None,
    mask: Bool[Array, "*batch view joint"] | None,
) -> Bool[Array, "*batch view joint"]:
    """Tell the key points that are finite, trusted, unmasked, and of a known camera."""
    usable = jnp.all(jnp.isfinite(uv_px), axis=-1) & cameras_known[..., None]
    usable = usable if mask is None else usable & mask
    return usable if confidence is None else usable & jnp.isfinite(confidence) & (confidence > 0)


def _clean_inputs(
    uv_px: Array,
    K: Array,
    T_cam_from_world: Array,
    confidence: Array | None,
    mask: Array | None,
    take_axis: int | None,
) -> tuple[
    Float[Array, "*batch view joint 2"],
    Float[Array, "*batch view joint"],
    Float[Array, "*batch view 3 3"],
    Float[Array, "*batch view 4 4"],
]:
    """Return finite pixels, weights that are zero where a key point does not count, and finite cameras."""
    views = uv_px.shape[-3]
    if views < _FEWEST_VIEWS:
        raise ValueError(f"triangulation needs at least two views; got `uv_px` of shape {uv_px.shape}")
    if K.shape[-3] != views:
        raise ValueError(f"`uv_px` has {views} views, the cameras {K.shape[-3]}; they must be the same")
    uv_px = jnp.asarray(uv_px)
    K, T, known = finite_cameras(K, T_cam_from_world, uv_px.shape[:-3])
    usable = usable_keypoints(uv_px, known, confidence, mask)
    weights = usable.astype(uv_px.dtype)
    if confidence is not None:
        weights = relative_confidence(jnp.asarray(confidence, uv_px.dtype), usable, take_axis)
    return jnp.where(usable[..., None], uv_px, 0), weights, K, T


def finite_cameras(
    K: Float[Array, "*#batch view 3 3"],
    T_cam_from_world: Float[Array, "*#batch view 4 4"],
    batch: tuple[int, ...],
) -> tuple[Float[Array, "*batch view 3 3"], Float[Array, "*batch view 4 4"], Bool[Array, "*batch view"]]:
    """Broadcast cameras over `batch`; those that are not finite become identities and are not known."""
    K, T = (jnp.broadcast_to(x, (*batch, *x.shape[-3:])) for x in map(jnp.asarray, (K, T_cam_from_world)))
    known = jnp.all(jnp.isfinite(K), (-2, -1)) & jnp.all(jnp.isfinite(T), (-2, -1))
    K = jnp.where(known[..., None, None], K, jnp.eye(3, dtype=K.dtype))
    return K, jnp.where(known[..., None, None], T, jnp.eye(4, dtype=T.dtype)), known


def _vote(
    uv: Array, weights: Array, K: Array, T: Array, gate_px: float
) -> tuple[Float[Array, "*batch joint 3"], Bool[Array, "*batch view joint"]]:
    """Return the proposal with the least truncated error, and the views that agree with it."""
    dlt, dlt_valid = triangulate(uv, K, T, weights=jnp.sqrt(weights), mask=weights > 0)
    pairs, pairs_valid = _midpoints(uv, weights, K, T)
    proposals = jnp.concatenate([dlt[..., None, :, :], pairs], axis=-3)
    allowed = jnp.concatenate([dlt_valid[..., None, :], pairs_valid], axis=-2)
    many = [x[..., None, :, :, :] for x in (uv, K, T)]
    error2, in_front = _square_errors(proposals, *many)
    error2 = jnp.where(in_front, error2 / gate_px**2, 1)
    cost = jnp.sum(weights[..., None, :, :] * jnp.minimum(error2, 1), axis=-2)
    best = jnp.argmin(jnp.where(allowed, cost, jnp.inf), axis=-2)[..., None, :]
    point = jnp.take_along_axis(proposals, best[..., None], axis=-3)[..., 0, :, :]
    agree = jnp.take_along_axis(error2, best[..., None, :], axis=-3)[..., 0, :, :] < 1
    enough = jnp.any(allowed, axis=-2)[..., None, :] & (weights > 0)
    return jax.lax.stop_gradient(point), agree & enough


def _midpoints(
    uv: Array, weights: Array, K: Array, T: Array
) -> tuple[Float[Array, "*batch pair joint 3"], Bool[Array, "*batch pair joint"]]:
    """Return the middle of the shortest segment between the two rays of every pair of views."""
    world_from_cam = invert_rigid(T)
    xy = normalised_from_pixels(K, uv)
    rays = rotate_points(world_from_cam[..., :3, :3], jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], -1))
    rays = rays / jnp.linalg.norm(rays, axis=-1, keepdims=True)
    centres = world_from_cam[..., None, :3, 3]
    a, b = np.array(list(combinations(range(uv.shape[-3]), 2))).T
    d, e = rays[..., a, :, :], rays[..., b, :, :]
    between = centres[..., b, :, :] - centres[..., a, :, :]
    cosine, along_d, along_e = (
        jnp.sum(x * y, -1, keepdims=True) for x, y in ((d, e), (d, between), (e, between))
    )
    sine2 = jnp.sum(jnp.cross(d, e) ** 2, -1, keepdims=True)
    safe = jnp.where(sine2 > _PARALLEL, sine2, 1)
    depth_d = (along_d - cosine * along_e) / safe
    depth_e = (cosine * along_d - along_e) / safe
    middle = 0.5 * (centres[..., a, :, :] + depth_d * d + centres[..., b, :, :] + depth_e * e)
    seen = (weights[..., a, :] > 0) & (weights[..., b, :] > 0)
    return middle, seen & (sine2 > _PARALLEL)[..., 0] & (depth_d > 0)[..., 0] & (depth_e > 0)[..., 0]


def _square_errors(
    points: Array, uv: Array, K: Array, T: Array
) -> tuple[Float[Array, "*batch view joint"], Bool[Array, "*batch view joint"]]:
    """Return squared reprojection errors (px^2) in every view, and whether the point lies in front of it."""
    projected, depth = project(K, T, points[..., None, :, :])
    return jnp.sum((projected - uv) ** 2, axis=-1), depth > 0


def _agreeing(
    points: Array, uv: Array, weights: Array, K: Array, T: Array, gate: Array, gate_px: float
) -> Bool[Array, "*batch view joint"]:
    """Tell the views within `gate` (px, of confidence 1) and `gate_px` of each point."""
    error2, in_front = _square_errors(points, uv, K, T)
    near = (weights * error2 < gate[..., None, None] ** 2) & (error2 < gate_px**2)
    return (weights > 0) & in_front & near


def projection_jacobian(
    K: Float[Array, "*#batch view 3 3"],
    T_cam_from_world: Float[Array, "*#batch view 4 4"],
    points: Float[Array, "*#batch joint 3"],
) -> tuple[Float[Array, "*batch view joint 2"], Float[Array, "*batch view joint 2 3"]]:
    """Return the pixels of world points in every view, and their derivative by the points.

    d (u, v) / d X = K_2x2 [R_xy - (x, y)/z R_z] / z (Hartley and Zisserman, section 6.2). Points at or behind
    a camera count as 1 cm in front of it, so that everything stays finite.
    """
    cam = transform_points(T_cam_from_world, points[..., None, :, :])
    depth = jnp.maximum(cam[..., 2:], 1e-2)
    xy = cam[..., :2] / depth
    R = T_cam_from_world[..., None, :3, :3]
    slope = (R[..., :2, :] - xy[..., None] * R[..., 2:, :]) / depth[..., None]
    focal = K[..., None, :2, :2]
    pixels = jnp.sum(focal * xy[..., None, :], -1) + K[..., None, :2, 2]
    return pixels, jnp.sum(focal[..., None] * slope[..., None, :, :], -2)


def _normal_equations(
    points: Array, uv: Array, weights: Array, K: Array, T: Array
) -> tuple[Float[Array, "*batch joint 3 3"], Float[Array, "*batch joint 3"]]:
    """Return sum_v w J^T J and sum_v w J^T r of every joint."""
    pixels, J = projection_jacobian(K, T, points)
    weighted = weights[..., None, None] * J
    H = jnp.sum(weighted[..., :, None] * J[..., None, :], axis=(-3, -5))
    g = jnp.sum(weighted * (pixels - uv)[..., None], axis=(-2, -4))
    return H, g


def _refine(points: Array, uv: Array, weights: Array, K: Array, T: Array) -> Float[Array, "*batch joint 3"]:
    """Take a few Gauss-Newton steps; joints with fewer than two views stay."""
    solvable = (jnp.sum(weights > 0, axis=-2) >= _FEWEST_VIEWS)[..., None]

    def step(points: Array, _: None) -> tuple[Array, None]:
        H, g = _normal_equations(points, uv, weights, K, T)
        step = jnp.sum(_inverse(H, solvable) * g[..., None, :], axis=-1)
        length = jnp.sqrt(jnp.maximum(jnp.sum(jnp.where(solvable, step, 1) ** 2, -1, keepdims=True), 1e-20))
        return points - jnp.where(solvable, step * jnp.minimum(1, 0.1 / length), 0), None

    # A loop of the program: written out, XLA:CPU fuses the steps into one kernel that overflows its stack.
    return jax.lax.scan(step, points, None, length=_STEPS)[0]


def _inverse(H: Array, solvable: Array) -> Float[Array, "*batch joint 3 3"]:
    """Invert symmetric 3x3 matrices by their adjugate, slightly damped; identity where not `solvable`."""
    eye = jnp.eye(3, dtype=H.dtype)
    scale = jnp.trace(H, axis1=-2, axis2=-1)[..., None, None] / 3
    scale = jnp.where(solvable[..., None] & (scale > 0), scale, 1)
    A = jnp.where(solvable[..., None], H / scale + _DAMPING * eye, eye)
    a, b, c = A[..., 0, :], A[..., 1, :], A[..., 2, :]
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    determinant = jnp.sum(a * adjugate[..., :, 0], axis=-1)[..., None, None]
    # Rounding of a rank-deficient matrix may leave nothing: the floor keeps steps and covariances finite.
    return adjugate / jnp.maximum(determinant, _DAMPING**2) / scale


def _residuals(
    points: Array, uv: Array, weights: Array, K: Array, T: Array
) -> tuple[Float[Array, "*batch joint"], Float[Array, "*batch joint"]]:
    """Return the weighted sum of squares of every joint (px^2), and its 2 v - 3 degrees of freedom."""
    count = jnp.sum(weights > 0, axis=-2)
    error2, _ = _square_errors(points, uv, K, T)
    counted = count >= _FEWEST_VIEWS
    square = jnp.where(counted, jnp.sum(weights * error2, axis=-2), 0)
    return square, jnp.where(counted, 2 * count - 3, 0).astype(square.dtype)


def _noise(
    square: Float[Array, "*batch joint"],
    freedom: Float[Array, "*batch joint"],
    take_axis: int | None,
    expected: KeypointNoise,
    *,
    by_median: bool,
) -> Float[Array, "*batch"]:
    """Estimate the noise of one coordinate over joints and the take, together with what was expected.

    Args:
        square, freedom: of `_residuals`.
        by_median: for residuals among which outliers may still be; else their mean. The median of chi^2_k / k
            is about (1 - 2 / 9k)^3 (Wilson and Hilferty 1931).
    """
    joints = freedom.ndim - 1
    axes = joints if take_axis is None else (take_axis % joints, joints)
    count = jnp.sum(freedom, axis=axes, keepdims=True)
    if by_median:
        k = jnp.maximum(freedom, 1)
        scaled = jnp.where(freedom > 0, square / k / (1 - 2 / (9 * k)) ** 3, jnp.nan)
        total = count * jnp.where(count > 0, jnp.nanmedian(scaled, axis=axes, keepdims=True), 0)
    else:
        total = jnp.sum(square, axis=axes, keepdims=True)
    variance = (_EXPECTED_COUNT * expected.expected_px**2 + total) / (_EXPECTED_COUNT + count)
    sigma = jnp.maximum(jnp.sqrt(variance), expected.least_px)[..., 0]
    return jnp.broadcast_to(sigma, freedom.shape[:-1])


def _with_uncertainty(
    points: Array, uv: Array, weights: Array, K: Array, T: Array, sigma: Array
) -> RobustPoints:
    inliers = weights > 0
    valid = (jnp.sum(inliers, axis=-2) >= _FEWEST_VIEWS) & jnp.all(jnp.isfinite(points), axis=-1)
    H, _ = _normal_equations(points, uv, weights, K, T)
    covariance = sigma[..., None, None, None] ** 2 * _inverse(H, valid[..., None])
    covariance = jnp.where(valid[..., None, None], covariance, 0)
    trace = jnp.trace(covariance, axis1=-2, axis2=-1) / 3
    sigma_m = jnp.where(valid, jnp.sqrt(jnp.where(valid, trace, 1)), 0)
    points = jnp.where(valid[..., None], points, 0)
    return RobustPoints(points, valid, covariance, sigma_m, inliers & valid[..., None, :], sigma)
