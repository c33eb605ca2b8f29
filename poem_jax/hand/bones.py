"""From the places of a hand's 21 key points to its shape and its pose, in closed form or nearly so.

Joints alone do not say how a finger is turned about its bone; the smallest turn is taken.
"""

import numpy as np

from poem_jax.geometry.alignment import procrustes
from poem_jax.geometry.transforms import matmul, smallest_rotation, transpose
from poem_jax.hand.model import HandModel, layer_tips
from poem_jax.hand.topology import (
    BONES,
    NUM_SHAPES,
    PALM_JOINTS,
    SKELETON_FINGERS,
    SKELETON_FROM_OPENPOSE,
    openpose_joints,
)
from poem_jax.typing import Array, Float, array_namespace

_SKELETON = np.array(SKELETON_FROM_OPENPOSE, np.int32)
_BONES = np.array(BONES)
_LENGTH_SIGMA_M = 0.001
"""How far a bone's length may be off; shape coefficients are about N(0, 1) beside it."""
_ITERATIONS = 8


def bone_rotations(
    palm: Float[Array, "*batch 3 3"], rest: Float[Array, "*batch 21 3"], joints: Float[Array, "*batch 21 3"]
) -> Float[Array, "*batch 16 3 3"]:
    """Return every joint's rotation relative to its parent, MANO order, by the smallest turn of its bone.

    Args:
        palm: R_world_from_rest of wrist and knuckles.
        rest: key points of the flat hand, OpenPose order.
        joints: key points as they are.
    """
    xp = array_namespace(palm, rest, joints)
    turn = xp.broadcast_to(palm[..., None, :, :], (*palm.shape[:-2], len(SKELETON_FINGERS), 3, 3))
    locals_ = []
    for skeleton_joints in np.array(SKELETON_FINGERS).T:
        start = _SKELETON[skeleton_joints]
        expected = rest[..., start + 1, :] - rest[..., start, :]
        observed = joints[..., start + 1, :] - joints[..., start, :]
        local = smallest_rotation(expected, matmul(transpose(turn), observed[..., None])[..., 0])
        turn = matmul(turn, local)
        locals_.append(local)
    fingers = xp.stack(locals_, -3).reshape(*palm.shape[:-2], -1, 3, 3)
    return xp.concatenate([palm[..., None, :, :], fingers], -3)


def rest_keypoints(hand: HandModel, shape: Float[Array, "10"]) -> Float[np.ndarray, "21 3"]:
    """Return the key points of a flat hand of given proportions, OpenPose order, metres; NumPy only."""
    shaped = hand.shape(np.asarray(shape, np.float64))
    return openpose_joints(shaped.skeleton, shaped.vertices[layer_tips(hand)])


def rotations_of_joints(
    hand: HandModel, shape: Float[Array, "10"], joints_world: Float[Array, "*batch 21 3"]
) -> Float[np.ndarray, "*batch 16 3 3"]:
    """Return the joints' rotations, MANO order, that bring a hand's bones to the directions of key points.

    The palm turns with the best rigid fit of wrist and knuckles, each finger bone by the smallest rotation.
    """
    joints = np.asarray(joints_world, np.float64)
    rest = np.broadcast_to(rest_keypoints(hand, shape), joints.shape)
    palm = np.array(PALM_JOINTS)
    fit = procrustes(rest[..., palm, :], joints[..., palm, :], with_scale=False)
    return bone_rotations(fit.R, rest, joints)


def shape_of_bones(hand: HandModel, lengths_m: Float[Array, "20"]) -> Float[np.ndarray, "10"]:
    """Return the shape coefficients whose 20 bones (`topology.BONES`) come nearest to given lengths.

    Gauss-Newton on the lengths, each off by 1 mm, with N(0, 1) for the coefficients.
    """
    zero, each = np.zeros(NUM_SHAPES), np.eye(NUM_SHAPES)
    mean = _bones(hand, zero)
    directions = np.stack([_bones(hand, one) - mean for one in each], -1)
    shape = zero
    for _ in range(_ITERATIONS):
        bones = mean + directions @ shape
        length = np.linalg.norm(bones, axis=-1)
        jacobian = np.einsum("bc,bcs->bs", bones / length[:, None], directions) / _LENGTH_SIGMA_M
        residual = (np.asarray(lengths_m, float) - length) / _LENGTH_SIGMA_M
        step = np.linalg.solve(jacobian.T @ jacobian + each, jacobian.T @ residual - shape)
        shape = shape + step
    return shape


def bone_lengths(joints: Float[Array, "*batch 21 3"]) -> Float[Array, "*batch 20"]:
    """Return the lengths of the 20 bones, in the unit of the joints."""
    xp = array_namespace(joints)
    return xp.linalg.norm(joints[..., _BONES[:, 1], :] - joints[..., _BONES[:, 0], :], axis=-1)


def _bones(hand: HandModel, shape: Float[Array, "10"]) -> Float[np.ndarray, "20 3"]:
    points = rest_keypoints(hand, shape)
    return points[_BONES[:, 1]] - points[_BONES[:, 0]]
