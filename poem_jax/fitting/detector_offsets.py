"""Where a detector of key points puts the 21 points of a hand, as offsets from those of the hand model.

Detectors are taught by people who mark pictures, and mark a finger's end on its pad, a knuckle on the skin.
An offset is one vector for each key point, fixed to the bone that carries it (`kinematics`: a joint follows
its parent's bone, a tip the last bone of its finger), in metres along the axes of `keypoint_axes`. It is
stated for a right hand and mirrored for a left one; it does not grow with the hand.
"""

import logging
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from poem_jax.geometry.transforms import unit_vectors
from poem_jax.hand.joint_limits import anatomical_axes
from poem_jax.hand.model import HandModel, mirror
from poem_jax.hand.topology import FINGER_JOINTS, NUM_JOINTS, ROOT_JOINT, SKELETON_FROM_OPENPOSE, WRIST
from poem_jax.typing import Float

AXIS_NAMES = ("along", "dorsal", "thumbwards")
"""Along the bone that ends at the key point, towards the tip; towards the back of the hand; and across both,
towards the thumb."""
MEDIAPIPE_HANDS = "mediapipe-hands"
"""The name of MediaPipe's networks in a file of key points, whichever program runs them."""
NO_DETECTOR = "none"
"""The name for: take the key points to be those of the hand model."""

_UP = np.array([0.0, 1.0, 0.0])
_MIRROR = np.array([-1.0, 1.0, 1.0])
"""The reflection that `hand.model.mirror` makes."""
_SKELETON = np.array(SKELETON_FROM_OPENPOSE, np.int32)

_log = logging.getLogger(__name__)


class KeypointOffsets(NamedTuple):
    """From the key points of a resting right hand to where a detector sees them."""

    offsets_m: Float[np.ndarray, "21 3"]
    """OpenPose order, metres, columns as `AXIS_NAMES`."""


_MEDIAPIPE_HANDS_MM = (
    (0.0, 0.0, 0.0),  # wrist
    (0.0, 0.0, 0.0),  # thumb, from its base to its tip
    (-2.3, -0.7, -0.2),
    (-6.6, -0.6, 0.6),
    (-8.4, 0.0, 0.0),
    (3.6, -0.6, -0.3),  # index
    (-2.2, 0.7, -0.3),
    (-3.7, -0.2, 0.2),
    (-6.3, 0.0, 0.0),
    (3.0, -0.7, -0.6),  # middle
    (-3.3, 0.0, -0.4),
    (-5.2, -0.5, 0.2),
    (-6.8, 0.0, 0.0),
    (4.7, -0.9, 0.2),  # ring
    (-1.7, -0.9, 0.3),
    (-4.9, -2.0, 0.8),
    (-8.1, 0.0, 0.0),
    (5.7, -0.5, 2.2),  # little
    (-0.1, -0.3, 0.6),
    (-1.2, -0.9, 0.5),
    (-5.2, 0.0, 0.0),
)
"""Against the shipped hand. Tips: from the outlines of real hands (tools/check_detector_offsets.py). Joints
of the fingers: from rendered hands (tools/measure_detector_offsets.py), kept as real hands are then covered
better. Wrist and base of the thumb: none, since what rendered hands show there, 16 and 13 mm along, makes
real hands 13 mm longer and covers them no better. docs/fitting.md has both columns."""

DETECTORS = MappingProxyType({MEDIAPIPE_HANDS: KeypointOffsets(1e-3 * np.array(_MEDIAPIPE_HANDS_MM))})
"""The detectors whose habits are known, by the name that a file of key points gives."""


def keypoint_axes(hand: HandModel) -> Float[np.ndarray, "21 3 3"]:
    """Return the unit axes of every key point of a resting right hand, rows as `AXIS_NAMES`, hand's frame.

    Those of joints beyond the knuckles and of tips are the anatomical axes of the joint before them
    (`hand.joint_limits`); wrist and knuckles have the bone from the wrist (for the wrist itself the one to
    the middle knuckle) and the direction of the nails.

    Raises:
        ValueError: a left hand; mirror it.
    """
    if hand.is_left:
        raise ValueError("the axes are those of a right hand; got a left one: mirror it")
    joints = np.asarray(hand.J_regressor, float) @ np.asarray(hand.v_template, float)
    flexion, abduction, twist = np.moveaxis(anatomical_axes(hand), 1, 0)
    axes = np.empty((NUM_JOINTS, 3, 3))
    for finger in FINGER_JOINTS:
        skeleton = [int(np.flatnonzero(joint == _SKELETON)[0]) for joint in finger[:-1]]
        bending = np.array(skeleton) - 1
        axes[finger[0]] = _palm_axes(joints[skeleton[0]] - joints[WRIST], abduction[bending[0]])
        axes[list(finger[1:])] = np.stack([twist, abduction, flexion], axis=1)[bending]
    middle = int(np.flatnonzero(_SKELETON == ROOT_JOINT)[0])
    axes[WRIST] = _palm_axes(joints[middle] - joints[WRIST], _UP)
    return axes


def rest_offsets(hand: HandModel, detector: KeypointOffsets) -> Float[np.ndarray, "21 3"]:
    """Return a detector's offsets in the frame of a resting hand of either side, metres."""
    hand = HandModel(*(np.asarray(array) for array in hand))
    right = mirror(hand) if hand.is_left else hand
    moved = np.einsum("jac,ja->jc", keypoint_axes(right), detector.offsets_m)
    return moved * _MIRROR if hand.is_left else moved


def offsets_of(detector: str | None) -> KeypointOffsets | None:
    """Return the calibration of a detector by its name; None, and a warning, where it is not known.

    `None` and "none" stand for key points that are taken to be those of the hand model.
    """
    if detector is None or detector == NO_DETECTOR:
        return None
    found = DETECTORS.get(detector)
    if found is None:
        _log.warning(
            "no calibration is known for the detector '%s' (known: %s): its key points are taken to be the "
            "joints and finger tips of the hand model",
            *(detector, ", ".join(DETECTORS)),
        )
    return found


def _palm_axes(bone: Float[np.ndarray, "3"], nail: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    along = unit_vectors(bone)
    dorsal = unit_vectors(nail - along * (nail @ along))
    return np.stack([along, dorsal, np.cross(dorsal, along)])
