"""Residuals of a hand fitted to key points: one short function each, in units of their standard deviation.

The cost of a residual vector r is |r|^2 / 2, except where a robust kernel replaces the square. Frames: world,
metres; pixels as in `geometry.cameras`; angles as in `hand.joint_limits`, radians. The released anatomical
terms have a file of their own, `anatomy_loss.py`.
"""

import jax.numpy as jnp

from poem_jax.fitting.observations import Observations
from poem_jax.geometry.cameras import projection_jacobian
from poem_jax.geometry.transforms import axis_angle_from_rotation, matmul, rotation_from_axis_angle, transpose
from poem_jax.typing import Array, Bool, Float

LIMIT_SIGMA = 0.2
"""Radians. How softly a joint is stopped beyond its limit: people differ by about this much (11 degrees)."""
MIN_PRIOR_SIGMA = 0.05
"""Radians. No angle is held tighter than this by the pose prior, however narrow its limits."""


def reprojection(
    joints_world: Float[Array, "*batch joint 3"], seen: Observations
) -> Float[Array, "*batch view joint 2"]:
    """Return projected minus observed pixels, times sqrt(weight), of clean observations."""
    pixels, _ = projection_jacobian(seen.K, seen.T_cam_from_world, joints_world)
    return jnp.sqrt(seen.weights)[..., None] * (pixels - seen.uv_px)


def joints_3d(
    joints_world: Float[Array, "*batch joint 3"],
    target_world: Float[Array, "*batch joint 3"],
    sigma_m: Float[Array, "*#batch joint"] | float,
    mask: Bool[Array, "*batch joint"] | None = None,
) -> Float[Array, "*batch joint 3"]:
    """Return the offset from given joints; zero where `mask` is False, whatever stands there."""
    if mask is None:
        return (joints_world - target_world) / jnp.asarray(sigma_m)[..., None]
    sigma_m = jnp.where(mask, sigma_m, 1)
    target_world = jnp.where(mask[..., None], target_world, joints_world)
    return (joints_world - target_world) / sigma_m[..., None]


def joint_limits(
    angles: Float[Array, "*batch 15 3"], limits: Float[Array, "15 3 2"], sigma: float = LIMIT_SIGMA
) -> Float[Array, "*batch 15 3"]:
    """Return how far each angle lies above (positive) or below (negative) its range; zero inside."""
    above = jnp.maximum(angles - limits[..., 1], 0)
    below = jnp.minimum(angles - limits[..., 0], 0)
    return (above + below) / sigma


def pose_prior(
    angles: Float[Array, "*batch 15 3"],
    limits: Float[Array, "15 3 2"],
    min_sigma: float = MIN_PRIOR_SIGMA,
) -> Float[Array, "*batch 15 3"]:
    """Return the distance of each angle from the middle of its range, in halves of the range.

    A normal prior from the limits alone, wider than the uniform distribution between them; it needs no
    recorded poses and none of MANO's data.
    """
    return (angles - jnp.mean(limits, axis=-1)) / prior_sigma(limits, min_sigma)


def prior_sigma(limits: Float[Array, "15 3 2"], min_sigma: float = MIN_PRIOR_SIGMA) -> Float[Array, "15 3"]:
    """Return the standard deviation of the pose prior, radians."""
    return jnp.maximum(0.5 * (limits[..., 1] - limits[..., 0]), min_sigma)


def shape_prior(shape: Float[Array, "*batch 10"]) -> Float[Array, "*batch 10"]:
    """Return the shape itself: coefficients are about N(0, 1)."""
    return shape


def smoothness(
    pose: Float[Array, "frame 16 3"],
    wrist: Float[Array, "frame 3"],
    sigma_angle: float,
    sigma_m: float,
) -> Float[Array, "step 51"]:
    """Return the change per frame: wrist's turn and finger angles / sigma_angle, place / sigma_m."""
    R = rotation_from_axis_angle(pose[:, 0])
    turn = axis_angle_from_rotation(matmul(R[1:], transpose(R[:-1])))
    fingers = (pose[1:, 1:] - pose[:-1, 1:]).reshape(pose.shape[0] - 1, 45)
    return jnp.concatenate(
        [turn / sigma_angle, fingers / sigma_angle, (wrist[1:] - wrist[:-1]) / sigma_m], axis=-1
    )


def geman_mcclure(square: Float[Array, "*batch"], scale: float | Array) -> Float[Array, "*batch"]:
    """Return c^2 s / (c^2 + s), the square s cut off smoothly at c^2 (Geman and McClure 1985)."""
    return square / (1 + square / scale**2)


def geman_mcclure_weight(square: Float[Array, "*batch"], scale: float | Array) -> Float[Array, "*batch"]:
    """Return the derivative of `geman_mcclure`: the weight of a residual in reweighted least squares."""
    return (1 + square / scale**2) ** -2
