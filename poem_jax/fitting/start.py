"""A closed-form pose from triangulated joints: where a solver begins, so that it needs no random restarts.

The palm turns with the best rigid fit of wrist and knuckles (Procrustes); every finger bone turns by the
smallest rotation that brings it from its parent's turn to its observed direction. Joints that nobody saw
stand where the fitted palm would carry them.
"""

import jax.numpy as jnp
import numpy as np

from poem_jax.fitting.kinematics import KeypointModel, joints_of, pose_keypoints
from poem_jax.geometry.alignment import apply_similarity, procrustes
from poem_jax.geometry.transforms import axis_angle_from_rotation, matmul, transpose
from poem_jax.hand.bones import bone_rotations
from poem_jax.hand.joint_limits import anatomical_angles
from poem_jax.hand.topology import NUM_JOINTS, NUM_SKELETON_JOINTS, PALM_JOINTS, WRIST
from poem_jax.typing import Array, Bool, Float

MIN_JOINTS = 3
"""Joints that a frame must have triangulated to be fitted."""
MIN_WIDTH_M = 0.005
"""And how far, root mean square, these must lie from one line: a hand could turn about it."""

_PALM = np.isin(np.arange(NUM_JOINTS), PALM_JOINTS)
_WRIST_OR_THUMB_BASE = np.isin(np.arange(NUM_JOINTS), PALM_JOINTS[:2])


def can_be_placed(
    joints_world: Float[Array, "*batch 21 3"],
    valid: Bool[Array, "*batch 21"],
    covariance: Float[Array, "*batch 21 3 3"],
) -> Bool[Array, "*batch"]:
    """Tell whether joints say where a hand is and how it is turned: enough of them, not all on one line.

    The second eigenvalue of their scatter decides; what three times the `covariance` (square metres) of the
    joints explains does not count as width.
    """
    count = jnp.sum(valid, axis=-1)
    share = (valid / jnp.maximum(count, 1)[..., None]).astype(joints_world.dtype)[..., None]
    offset = joints_world - jnp.sum(share * joints_world, axis=-2, keepdims=True)
    scatter = matmul(transpose(share * offset), offset)
    noise = jnp.sum(share[..., None] * covariance, axis=-3)
    width = jnp.linalg.eigvalsh(scatter - 3 * noise)[..., 1]
    return (count >= MIN_JOINTS) & (width > MIN_WIDTH_M**2)


def closed_form_pose(
    model: KeypointModel,
    joints_world: Float[Array, "*batch 21 3"],
    valid: Bool[Array, "*batch 21"],
    shape: Float[Array, "*batch 10"],
) -> tuple[Float[Array, "*batch 16 3"], Float[Array, "*batch 3"]]:
    """Return axis-angle pose and wrist place (metres, world) that bring a hand's bones to observed joints.

    Args:
        joints_world: triangulated key points, metres; anything finite where not `valid`.
        valid: key points to go by. Frames with fewer than three of them get a finite pose that means nothing.
        shape: proportions of the hand at rest.

    Returns: the pose, its angles inside the limits of the joints; and the place of the wrist.
    """
    flat = jnp.zeros((*shape.shape[:-1], NUM_SKELETON_JOINTS, 3), shape.dtype)
    posed = pose_keypoints(model, flat, shape)
    rest = posed.points
    palm = valid & _PALM
    # The knuckles alone lie nearly on one line, about which the palm could turn.
    enough = (jnp.sum(palm, -1) >= MIN_JOINTS) & jnp.any(valid & _WRIST_OR_THUMB_BASE, -1)
    used = jnp.where(enough[..., None], palm, valid)
    fit = procrustes(rest, joints_world, with_scale=False, mask=used)
    joints = jnp.where(valid[..., None], joints_world, apply_similarity(fit, rest))
    pose = axis_angle_from_rotation(bone_rotations(fit.R, rest, joints))
    wrist = joints[..., WRIST, :]
    if model.offsets is not None:
        # The wrist's key point lies beside the wrist, and turns with the palm.
        beside = rest[..., WRIST, :] - joints_of(model, posed)[..., WRIST, :]
        wrist = wrist - matmul(fit.R, beside[..., None])[..., 0]
    return _within_limits(model, pose), wrist


def _within_limits(model: KeypointModel, pose: Float[Array, "*batch 16 3"]) -> Float[Array, "*batch 16 3"]:
    angles = anatomical_angles(pose, model.axes)
    angles = jnp.clip(angles, model.limits[..., 0], model.limits[..., 1])
    fingers = jnp.sum(angles[..., None] * model.axes, axis=-2)
    return jnp.concatenate([pose[..., :1, :], fingers], axis=-2)
