"""Anatomical angles of the bending joints, and how far each of them goes.

An angle vector has shape (..., 15, 3): the joints of MANO's skeleton without the wrist, in MANO's order, and
per joint flexion (positive = towards the palm), abduction (positive = towards the thumb's side; for the
thumb out of the palm's plane) and twist (about the bone), radians. They are the components of the joint's
axis-angle vector along its anatomical axes.

Limits follow the active ranges of adult hands (American Academy of Orthopaedic Surgeons, Joint Motion,
1965; Hume et al., J. Hand Surg. 15A, 1990), rounded; joints that only hinge keep a few degrees of play off
their axis.
"""

import numpy as np

from poem_jax.geometry.transforms import unit_vectors
from poem_jax.hand.model import HandModel, mirror
from poem_jax.hand.topology import (
    FINGER_NAMES,
    MANO_FINGER_NAMES,
    NUM_SKELETON_JOINTS,
    SKELETON_FINGERS,
    TIP_VERTICES_LAYER,
)
from poem_jax.typing import Array, Float

NUM_BENDING_JOINTS = NUM_SKELETON_JOINTS - 1
ANGLE_NAMES = ("flexion", "abduction", "twist")

_HINGE = ((-3, 3), (-3, 3))
LIMITS_DEG = {
    "index": (((-20, 85), (-14, 16), (-5, 5)), ((0, 100), *_HINGE), ((0, 65), *_HINGE)),
    "middle": (((-20, 85), (-12, 12), (-5, 5)), ((0, 100), *_HINGE), ((0, 65), *_HINGE)),
    "ring": (((-20, 85), (-14, 12), (-5, 5)), ((0, 100), *_HINGE), ((0, 65), *_HINGE)),
    "little": (((-20, 85), (-18, 14), (-5, 5)), ((0, 100), *_HINGE), ((0, 65), *_HINGE)),
    "thumb": (((-15, 30), (-8, 30), (-10, 25)), ((-10, 50), (-6, 6), (-5, 5)), ((-15, 70), *_HINGE)),
}
"""(lowest, highest) per finger, joint (palm outwards) and angle (columns as ANGLE_NAMES), degrees."""
POSE_LIMITS: Float[np.ndarray, "15 3 2"] = np.deg2rad(
    np.array([LIMITS_DEG[name] for name in MANO_FINGER_NAMES], dtype=float).reshape(-1, 3, 2)
)
"""(lowest, highest) of every angle, radians; joints in MANO's order, columns as ANGLE_NAMES."""

_UP = np.array([0.0, 1.0, 0.0])
_THUMB_NAIL = np.array([0.35, 0.70, 0.62])
"""Where the nails of a right hand point at rest."""
_MANO_FROM_OPENPOSE_FINGER = [FINGER_NAMES.index(name) for name in MANO_FINGER_NAMES]
_MIRROR_AXES = np.array([1.0, -1.0, -1.0])
"""What a reflection in the Y-Z plane does to a rotation axis."""


def axes_of_fingers(points: Float[np.ndarray, "5 4 3"]) -> Float[np.ndarray, "15 3 3"]:
    """Return unit axes (rows flexion, abduction, twist) of each joint of a right hand at rest, orthonormal.

    Twist runs along the bone and abduction about the direction of the nail; in the thumb that one is turned
    out of the palm's plane.

    Args:
        points: joints and tip of each finger at rest, fingers in MANO's order, metres, MANO's frame.
    """
    bones = (points[:, 1:] - points[:, :-1]).reshape(-1, 3)
    twist = unit_vectors(bones)
    nail = np.repeat(np.where(np.array(MANO_FINGER_NAMES)[:, None] == "thumb", _THUMB_NAIL, _UP), 3, axis=0)
    abduction = unit_vectors(nail - twist * (nail * twist).sum(-1, keepdims=True))
    return np.stack([np.cross(abduction, twist), abduction, twist], axis=-2)


def resting_fingers(hand: HandModel) -> Float[np.ndarray, "5 4 3"]:
    """Return joints and tip of each finger of a resting right hand, fingers in MANO's order, metres."""
    template = np.asarray(hand.v_template, float)
    joints = (np.asarray(hand.J_regressor, float) @ template)[np.array(SKELETON_FINGERS)]
    tips = template[np.array(TIP_VERTICES_LAYER)[_MANO_FROM_OPENPOSE_FINGER]]
    return np.concatenate([joints, tips[:, None]], axis=1)


def anatomical_axes(hand: HandModel) -> Float[np.ndarray, "15 3 3"]:
    """Return `axes_of_fingers` for the mean shape of any hand in MANO's frame, left hands by mirroring."""
    hand = HandModel(*(np.asarray(array) for array in hand))
    axes = axes_of_fingers(resting_fingers(mirror(hand) if hand.is_left else hand))
    return axes * _MIRROR_AXES if hand.is_left else axes


def anatomical_angles(
    pose: Float[Array, "*batch 16 3"], axes: Float[Array, "15 3 3"]
) -> Float[Array, "*batch 15 3"]:
    """Return flexion, abduction and twist of every bending joint; linear in the axis-angle `pose`."""
    return (axes * pose[..., 1:, None, :]).sum(-1)
