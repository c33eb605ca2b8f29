"""Robust triangulation: which views agree on a joint, where it is, and how far that can be trusted.

For every joint each pair of views proposes a point (the middle of the shortest segment between its two rays)
and the weighted DLT of all views proposes one more; all views vote on every proposal by their truncated
reprojection error. The views that agree with the winner are its inliers, and Gauss-Newton steps on their
reprojection error refine it. Up to 25 cameras this search is exhaustive: no random samples.

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

from poem_jax.fitting.observations import Observations, clean, point_information
from poem_jax.geometry.cameras import normalised_from_pixels, project
from poem_jax.geometry.transforms import invert_rigid, rotate_points, unit_vectors
from poem_jax.geometry.triangulation import triangulate
from poem_jax.typing import Array, Bool, Float, Int, Num

REFERENCE_DIAGONAL_PX = math.hypot(1280, 720)
"""Of the images that defaults in pixels are meant for."""

MAX_PAIRS = 300
"""Pairs of views that propose a point: all, up to 25 views. Memory grows with pairs times views."""

_STEPS = 4
_MIN_VIEWS = 2
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
    min_px: float = 0.3
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
    observations: Observations,
    *,
    noise: KeypointNoise = KeypointNoise(),
    frame_axis: int | None = None,
) -> RobustPoints:
    """Triangulate joints from the views that agree with each other.

    Args:
        observations: key points and their cameras; the batch axes of the cameras broadcast.
        noise: what to expect of the key points; static under `jax.jit`.
        frame_axis: batch axis (say, of frames) over which the noise is estimated together; None estimates it
            for each batch entry from its own joints.

    Returns: see `RobustPoints`. Differentiable with respect to the pixels, the cameras and the weights at
    fixed inliers.

    Raises:
        ValueError: fewer than two views, or key points and cameras of different numbers of views.
    """
    views = observations.uv_px.shape[-3]
    if views < _MIN_VIEWS:
        raise ValueError(f"triangulation needs at least two views; got `uv_px` of {observations.uv_px.shape}")
    if observations.K.shape[-3] != views:
        cameras = observations.K.shape[-3]
        raise ValueError(f"`uv_px` has {views} views, the cameras {cameras}; they must be the same")
    seen = clean(observations, frame_axis)
    points, inliers = _vote(seen, noise.gate_px)
    used = _only(seen, inliers)
    points = _refine(points, used)
    sigma = _noise(*_residuals(points, used), frame_axis, noise, by_median=True)
    inliers = _agreeing(points, seen, _GATE_SIGMAS * sigma, noise.gate_px)
    used = _only(seen, inliers & (jnp.sum(inliers, -2, keepdims=True) >= _MIN_VIEWS))
    points = _refine(points, used)
    sigma = _noise(*_residuals(points, used), frame_axis, noise, by_median=False)
    return _with_uncertainty(points, used, sigma)


def _only(seen: Observations, inliers: Bool[Array, "*batch view joint"]) -> Observations:
    return seen._replace(weights=seen.weights * inliers)


def _vote(
    seen: Observations, gate_px: float
) -> tuple[Float[Array, "*batch joint 3"], Bool[Array, "*batch view joint"]]:
    """Return the proposal with the least truncated error, and the views that agree with it."""
    uv, weights, K, T = seen
    dlt, dlt_valid = triangulate(uv, K, T, weights=jnp.sqrt(weights), mask=weights > 0)
    pairs, pairs_valid = _midpoints(seen)
    proposals = jnp.concatenate([dlt[..., None, :, :], pairs], axis=-3)
    allowed = jnp.concatenate([dlt_valid[..., None, :], pairs_valid], axis=-2)
    every = Observations(uv[..., None, :, :, :], None, K[..., None, :, :, :], T[..., None, :, :, :])
    error2, in_front = _square_errors(proposals, every)
    error2 = jnp.where(in_front, error2 / gate_px**2, 1)
    cost = jnp.sum(weights[..., None, :, :] * jnp.minimum(error2, 1), axis=-2)
    best = jnp.argmin(jnp.where(allowed, cost, jnp.inf), axis=-2)[..., None, :]
    point = jnp.take_along_axis(proposals, best[..., None], axis=-3)[..., 0, :, :]
    agree = jnp.take_along_axis(error2, best[..., None, :], axis=-3)[..., 0, :, :] < 1
    enough = jnp.any(allowed, axis=-2)[..., None, :] & (weights > 0)
    return jax.lax.stop_gradient(point), agree & enough


def _midpoints(
    seen: Observations,
) -> tuple[Float[Array, "*batch pair joint 3"], Bool[Array, "*batch pair joint"]]:
    """Return the middle of the shortest segment between the two rays of every pair of views."""
    uv, weights, K, T = seen
    world_from_cam = invert_rigid(T)
    xy = normalised_from_pixels(K, uv)
    rays = rotate_points(world_from_cam[..., :3, :3], jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], -1))
    rays = unit_vectors(rays)
    centres = world_from_cam[..., None, :3, 3]
    a, b = _pairs(uv.shape[-3])
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
    both = (weights[..., a, :] > 0) & (weights[..., b, :] > 0)
    return middle, both & (sine2 > _PARALLEL)[..., 0] & (depth_d > 0)[..., 0] & (depth_e > 0)[..., 0]


def _pairs(num_views: int) -> Int[Array, "2 pair"]:
    """Return all pairs of views; of many views so many pairs that each view is in as many as any other."""
    pairs = np.array(list(combinations(range(num_views), 2)))
    steps = max(1, MAX_PAIRS // num_views)
    if len(pairs) > MAX_PAIRS:
        # Neighbours in the rig's order up to opposite ones.
        apart = np.unique(np.linspace(1, num_views // 2, steps).round().astype(int))
        first = np.arange(num_views)
        pairs = np.concatenate([np.stack([first, (first + step) % num_views], 1) for step in apart])
    return pairs.T


def _square_errors(
    points: Array, seen: Observations
) -> tuple[Float[Array, "*batch view joint"], Bool[Array, "*batch view joint"]]:
    """Return squared reprojection errors (px^2) in every view, and whether the point lies in front of it."""
    projected, depth = project(seen.K, seen.T_cam_from_world, points[..., None, :, :])
    return jnp.sum((projected - seen.uv_px) ** 2, axis=-1), depth > 0


def _agreeing(
    points: Array, seen: Observations, gate: Array, gate_px: float
) -> Bool[Array, "*batch view joint"]:
    """Tell the views within `gate` (px, of confidence 1) and `gate_px` of each point."""
    error2, in_front = _square_errors(points, seen)
    near = (seen.weights * error2 < gate[..., None, None] ** 2) & (error2 < gate_px**2)
    return (seen.weights > 0) & in_front & near


def _refine(points: Array, seen: Observations) -> Float[Array, "*batch joint 3"]:
    """Take a few Gauss-Newton steps; joints with fewer than two views stay."""
    solvable = (jnp.sum(seen.weights > 0, axis=-2) >= _MIN_VIEWS)[..., None]

    def step(points: Array, _: None) -> tuple[Array, None]:
        H, g = point_information(points, seen)
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
    points: Array, seen: Observations
) -> tuple[Float[Array, "*batch joint"], Float[Array, "*batch joint"]]:
    """Return the weighted sum of squares of every joint (px^2), and its 2 v - 3 degrees of freedom."""
    count = jnp.sum(seen.weights > 0, axis=-2)
    error2, _ = _square_errors(points, seen)
    counted = count >= _MIN_VIEWS
    square = jnp.where(counted, jnp.sum(seen.weights * error2, axis=-2), 0)
    return square, jnp.where(counted, 2 * count - 3, 0).astype(square.dtype)


def _noise(
    square: Float[Array, "*batch joint"],
    freedom: Float[Array, "*batch joint"],
    frame_axis: int | None,
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
    axes = joints if frame_axis is None else (frame_axis % joints, joints)
    count = jnp.sum(freedom, axis=axes, keepdims=True)
    if by_median:
        k = jnp.maximum(freedom, 1)
        scaled = jnp.where(freedom > 0, square / k / (1 - 2 / (9 * k)) ** 3, jnp.nan)
        total = count * jnp.where(count > 0, jnp.nanmedian(scaled, axis=axes, keepdims=True), 0)
    else:
        total = jnp.sum(square, axis=axes, keepdims=True)
    variance = (_EXPECTED_COUNT * expected.expected_px**2 + total) / (_EXPECTED_COUNT + count)
    sigma = jnp.maximum(jnp.sqrt(variance), expected.min_px)[..., 0]
    return jnp.broadcast_to(sigma, freedom.shape[:-1])


def _with_uncertainty(points: Array, seen: Observations, sigma: Array) -> RobustPoints:
    inliers = seen.weights > 0
    valid = (jnp.sum(inliers, axis=-2) >= _MIN_VIEWS) & jnp.all(jnp.isfinite(points), axis=-1)
    H, _ = point_information(points, seen)
    covariance = sigma[..., None, None, None] ** 2 * _inverse(H, valid[..., None])
    covariance = jnp.where(valid[..., None, None], covariance, 0)
    trace = jnp.trace(covariance, axis1=-2, axis2=-1) / 3
    sigma_m = jnp.where(valid, jnp.sqrt(jnp.where(valid, trace, 1)), 0)
    points = jnp.where(valid[..., None], points, 0)
    return RobustPoints(points, valid, covariance, sigma_m, inliers & valid[..., None, :], sigma)
