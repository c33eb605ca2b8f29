"""The anatomical terms of POEM v1's released fitting code, equal to it number by number.

Letters, all unit vectors in the joint's own frame, one per bending joint in MANO's order: b = along the bone,
from the next joint (towards the tip) to this one; l = b x up; u = l x b; a = the axis about which the joint
is turned. A joint turned by less than 0.01 rad says nothing about its axis and counts as right. Joints come
in three groups: knuckles and thumb base may deviate, the other ten must not ("restricted").
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from poem_jax.geometry.transforms import matmul, rotation_from_axis_angle, transpose, unit_vectors
from poem_jax.hand.topology import NUM_SKELETON_JOINTS, SKELETON_FROM_OPENPOSE
from poem_jax.typing import Array, Bool, Float

MIN_ANGLE = 0.01
"""Radians."""
TERM_WEIGHTS = (1.0, 0.1, 0.1, 1.0, 0.1, 0.1)
"""The release's weights, in the order of `AnatomyTerms`."""

_THUMB = np.array([12], np.int32)
_KNUCKLES = np.array([0, 3, 9, 6], np.int32)
_RESTRICTED = np.array([1, 2, 4, 5, 7, 8, 10, 11, 13, 14], np.int32)
_UP = np.where(np.arange(NUM_SKELETON_JOINTS - 1)[:, None] < 12, [[0.0, 1.0, 0.0]], [[1.0, 1.0, 1.0]])
_JOINTS = np.array(SKELETON_FROM_OPENPOSE, np.int32)[1:]


class AnatomyTerms(NamedTuple):
    """The six terms, in the order of the release."""

    quaternion_norm: Float[Array, "*batch"]
    shape: Float[Array, "*batch"]
    angle: Float[Array, "*batch"]
    b: Float[Array, "*batch"]
    u: Float[Array, "*batch"]
    l: Float[Array, "*batch"]  # noqa: E741


class BoneAxes(NamedTuple):
    """The three axes of every bending joint."""

    b: Float[Array, "*batch 15 3"]
    u: Float[Array, "*batch 15 3"]
    l: Float[Array, "*batch 15 3"]  # noqa: E741


def anatomy_terms(
    quaternions: Float[Array, "*batch 16 4"],
    shape: Float[Array, "*batch 10"],
    rotations: Float[Array, "*batch 16 3 3"],
    joints: Float[Array, "*batch 21 3"],
    is_left: bool | Bool[Array, ""] = False,
) -> AnatomyTerms:
    """Return all six terms of a pose.

    Args:
        quaternions: raw, wxyz, MANO order; only their directions turn joints.
        shape: about N(0, 1).
        rotations: world rotations of the joints that the quaternions give.
        joints: the posed key points, OpenPose order, metres.
        is_left: the hand is a left one. (The release knows right ones; a left hand's terms are those of its
            mirror image.)
    """
    axes = bone_axes(rotations, joints, is_left)
    axis, angle = axis_and_angle(axis_angle_from_raw_quaternion(quaternions)[..., 1:, :])
    return AnatomyTerms(
        quaternion_norm(quaternions),
        jnp.sum(shape * shape, axis=-1),
        large_angle(angle),
        off_axis(axes.b, axis, angle, np.pi / 36, np.pi / 9),
        off_axis(axes.u, axis, angle, np.pi / 6, np.pi / 3),
        wrong_way(axes.l, axis, angle, np.pi / 9, np.pi / 3),
    )


def anatomy_loss(terms: AnatomyTerms) -> Float[Array, "*batch"]:
    """Return the weighted sum of the terms, with the release's weights."""
    return sum(weight * term for weight, term in zip(TERM_WEIGHTS, terms, strict=True))


def quaternion_norm(quaternions: Float[Array, "*batch 16 4"]) -> Float[Array, "*batch"]:
    """Return the mean of (|q|^2 - 1)^2."""
    return jnp.mean((jnp.sum(quaternions * quaternions, axis=-1) - 1) ** 2, axis=-1)


def large_angle(angle: Float[Array, "*batch 15"]) -> Float[Array, "*batch"]:
    """Return the mean square of what angles (radians) have above 90 degrees."""
    return jnp.mean(jnp.maximum(angle - np.pi / 2, 0) ** 2, axis=-1)


def off_axis(
    direction: Float[Array, "*batch 15 3"],
    axis: Float[Array, "*batch 15 3"],
    angle: Float[Array, "*batch 15"],
    knuckle_play: float,
    thumb_play: float,
) -> Float[Array, "*batch"]:
    """Return how far joints turn about `direction` instead of across it; plays in radians (terms b and u)."""
    cosine = jnp.sum(direction * axis, axis=-1)
    knuckle, thumb = (jnp.maximum(jnp.abs(cosine) - np.sin(play), 0) for play in (knuckle_play, thumb_play))
    return _grouped(cosine, knuckle, thumb, angle)


def wrong_way(
    direction: Float[Array, "*batch 15 3"],
    axis: Float[Array, "*batch 15 3"],
    angle: Float[Array, "*batch 15"],
    knuckle_play: float,
    thumb_play: float,
) -> Float[Array, "*batch"]:
    """Return how far joints do not turn about `direction`; plays in radians (term l)."""
    missing = 1 - jnp.sum(direction * axis, axis=-1)
    knuckle, thumb = (jnp.maximum(missing - np.sin(play), 0) for play in (knuckle_play, thumb_play))
    return _grouped(missing, knuckle, thumb, angle)


def bone_axes(
    rotations: Float[Array, "*batch 16 3 3"],
    joints: Float[Array, "*batch 21 3"],
    is_left: bool | Bool[Array, ""] = False,
) -> BoneAxes:
    """Return b, u and l of every bending joint, in the joint's own frame."""
    bone = joints[..., _JOINTS, :] - joints[..., _JOINTS + 1, :]
    b = unit_vectors(matmul(transpose(rotations[..., 1:, :, :]), bone[..., None])[..., 0])
    up = jnp.asarray(_UP, b.dtype) * jnp.where(is_left, jnp.asarray([-1, 1, 1], b.dtype), 1)
    l = unit_vectors(jnp.cross(b, up))  # noqa: E741
    return BoneAxes(b, jnp.cross(l, b), l)


def rotations_from_raw_quaternions(quaternions: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Return the rotations of quaternions wxyz of any length but zero."""
    return rotation_from_axis_angle(axis_angle_from_raw_quaternion(quaternions))


def axis_angle_from_raw_quaternion(quaternions: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3"]:
    """Return axis-angle vectors of quaternions wxyz of any length but zero.

    As the release: the angle is 2 atan2(|xyz|, w), so above 180 degrees where w is negative.
    """
    w, v = quaternions[..., :1], quaternions[..., 1:]
    n2 = jnp.sum(v * v, axis=-1, keepdims=True)
    still = n2 <= 1e-24
    n = jnp.sqrt(jnp.where(still, 1, n2))
    return v * jnp.where(still, 2 / jnp.where(still, w, 1), 2 * jnp.arctan2(n, w) / n)


def axis_and_angle(
    v: Float[Array, "*batch 15 3"],
) -> tuple[Float[Array, "*batch 15 3"], Float[Array, "*batch 15"]]:
    """Split axis-angle vectors; a zero vector has axis zero."""
    a2 = jnp.sum(v * v, axis=-1)
    still = a2 <= 1e-24
    angle = jnp.sqrt(jnp.where(still, 1, a2))
    return v / angle[..., None], jnp.where(still, 0, angle)


def _grouped(restricted: Array, knuckle: Array, thumb: Array, angle: Array) -> Array:
    """Sum the mean squares of the three groups; joints hardly turned count as zero."""
    turned = angle >= MIN_ANGLE
    groups = ((restricted, _RESTRICTED), (knuckle, _KNUCKLES), (thumb, _THUMB))
    return sum(jnp.mean((value**2 * turned)[..., group], axis=-1) for value, group in groups)
