"""Query points before the first layer: the hand template, or the template posed by triangulated joints.

Posing by joints: the palm turns with the frame spanned by wrist and knuckles, every finger bone turns by the
smallest rotation that brings it from its parent's turn to its observed direction, and the surface follows by
skinning. Joints are taken as they are, so that proportions follow too.
"""

import jax.numpy as jnp
import numpy as np

from poem_jax.geometry.transforms import matmul, rotation_from_6d, smallest_rotation, transpose
from poem_jax.hand.model import HandModel, PosedHand
from poem_jax.hand.topology import NUM_SKELETON_JOINTS, SKELETON_FROM_OPENPOSE, WRIST
from poem_jax.typing import Array, Float

_SKELETON = np.array(SKELETON_FROM_OPENPOSE, np.int32)
_CHAINS = np.arange(1, NUM_SKELETON_JOINTS, dtype=np.int32).reshape(5, 3)
_KNUCKLES = np.array([5, 9, 13, 17], np.int32)
_ACROSS = np.array([1.0, 0.5, -0.5, -1.0])
"""Weights of the knuckles (index to little) for the direction across the palm."""


def pose_by_joints(
    hand: HandModel,
    template_vertices: Float[Array, "778 3"],
    template_joints: Float[Array, "21 3"],
    joints: Float[Array, "batch 21 3"],
) -> Float[Array, "batch 778 3"]:
    """Return the template's vertices, carried along by the joints; finite, with its gradient, for any joints.

    Args:
        hand: its skin weights are used.
        template_vertices: hand at rest, metres, in the frame of `template_joints`.
        template_joints: the joints at rest, OpenPose order.
        joints: where they were observed, metres, any frame.
    """
    palm = matmul(transpose(_palm_frame(joints)), _palm_frame(template_joints))
    turns = _bone_turns(palm, template_joints, joints)
    rest = template_joints[_SKELETON]
    return PosedHand(hand, template_vertices, rest, turns, joints[..., _SKELETON, :]).skin().vertices


def _palm_frame(joints: Float[Array, "*batch 21 3"]) -> Float[Array, "*batch 3 3"]:
    """Return rows: along the palm (wrist to knuckles), across it, and its normal."""
    knuckles = joints[..., _KNUCKLES, :]
    along = jnp.mean(knuckles, -2) - joints[..., WRIST, :]
    across = jnp.einsum("k,...kx->...x", jnp.asarray(_ACROSS, joints.dtype), knuckles)
    return rotation_from_6d(jnp.concatenate([along, across], -1))


def _bone_turns(
    palm: Float[Array, "batch 3 3"], rest: Float[Array, "21 3"], joints: Float[Array, "batch 21 3"]
) -> Float[Array, "batch 16 3 3"]:
    """Return the rotation of every skeleton joint (MANO order), composed along the fingers."""
    turn = jnp.broadcast_to(palm[:, None], (palm.shape[0], len(_CHAINS), 3, 3))
    turns = []
    for depth in range(_CHAINS.shape[1]):
        start = _SKELETON[_CHAINS[:, depth]]
        expected = matmul(turn, (rest[start + 1] - rest[start])[..., None])[..., 0]
        turn = matmul(smallest_rotation(expected, joints[:, start + 1] - joints[:, start]), turn)
        turns.append(turn)
    fingers = jnp.stack(turns, 2).reshape(palm.shape[0], -1, 3, 3)
    return jnp.concatenate([palm[:, None], fingers], 1)
