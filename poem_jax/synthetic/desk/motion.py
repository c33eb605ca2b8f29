"""What the two hands do: postures of the fingers and places of the wrist, as closed curves in time.

Everything is written for a right hand; what the left one does is reflected in the plane x = 0. After
`PERIOD_S` the hands are where they began, so that the take can be shown in a loop.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation

from poem_jax.hand.joint_limits import POSE_LIMITS
from poem_jax.hand.model import hand_mesh, mirror_pose
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import MANO_FINGER_NAMES, WRIST
from poem_jax.synthetic.poses import angles_to_pose
from poem_jax.typing import Array, Float

PERIOD_S = 3.0
SIDES = ("left", "right")
"""Order of the hands wherever there is an axis for them."""
SHAPE = np.array([0.3, 0.2, 0.2, 0.0, 0.2, 0.0, 0.0, 0.3, 0.0, 0.0], np.float32)
"""The person's hands, in the shape coefficients of the shipped hand."""

Posture = dict[str, tuple[int, ...]]
"""Degrees. Per long finger: flexion and abduction of the knuckle, flexion of the next two joints. For the
thumb: flexion, abduction and twist of its base, flexion of the next two joints."""

_CURLED = (76, 0, 94, 52)
_RELAXED: Posture = {
    "index": (16, 3, 22, 12),
    "middle": (22, 0, 28, 14),
    "ring": (27, -2, 32, 16),
    "little": (30, -6, 34, 16),
    "thumb": (4, 8, 0, 10, 12),
}
_SPREAD: Posture = {
    "index": (-6, 12, 4, 2),
    "middle": (-8, 2, 4, 2),
    "ring": (-6, -9, 4, 2),
    "little": (-4, -16, 6, 3),
    "thumb": (-10, 18, -5, -4, -6),
}
_ONE: Posture = {
    "index": (0, 2, 6, 3),
    "middle": _CURLED,
    "ring": _CURLED,
    "little": (74, 0, 90, 50),
    "thumb": (20, 22, 12, 30, 28),
}
_TWO: Posture = _ONE | {"index": (-4, 12, 4, 2), "middle": (-4, -8, 4, 2), "thumb": (24, 22, 14, 36, 30)}
_THREE: Posture = _TWO | {"index": (-4, 6, 4, 2), "middle": (-4, 0, 4, 2), "thumb": (-12, 14, -6, -4, -6)}
_GRASP: Posture = {
    "index": (34, 8, 42, 24),
    "middle": (36, 2, 46, 26),
    "ring": (38, -6, 46, 26),
    "little": (38, -12, 44, 24),
    "thumb": (-6, 26, 10, 12, 18),
}
_PINCH: Posture = {
    "index": (55, -6, 45, 27),
    "middle": (20, 0, 26, 12),
    "ring": (10, -4, 18, 10),
    "little": (4, -10, 14, 8),
    "thumb": (23, 10, 14, 17, 32),
}

_LAG_S = {"index": 0.0, "middle": 0.02, "ring": 0.05, "little": 0.08, "thumb": 0.03}
"""Fingers do not move as one."""


class _Part(NamedTuple):
    """What one hand does, as a right hand: rows are equally spaced in time."""

    postures: tuple[Posture, ...]
    place_cm: tuple[tuple[int, int, int], ...]
    """Of the wrist, in the world."""
    turn_deg: tuple[tuple[int, int, int], ...]
    """From fingers up and palm away from the person: turn about the fingers (positive: the palm towards the
    other hand), tip of the fingers (positive: towards the person), lean (positive: outwards)."""


_PARTS = {
    "right": _Part(
        (_SPREAD, _SPREAD, _ONE, _TWO, _TWO, _THREE, _GRASP, _RELAXED),
        (
            *((13, -3, 16), (15, -2, 18), (12, 0, 19), (7, 3, 18)),
            *((4, 5, 15), (8, 3, 14), (12, -2, 13), (13, -4, 14)),
        ),
        (
            *((20, -30, 4), (10, -26, 8), (15, -30, 0), (30, -34, -14)),
            *((40, -38, -20), (45, -40, -16), (65, -46, -12), (45, -40, -6)),
        ),
    ),
    "left": _Part(
        (_RELAXED, _PINCH, _PINCH, _RELAXED, _GRASP, _GRASP, _SPREAD, _SPREAD),
        (
            *((11, -2, 13), (9, 0, 15), (8, -3, 15), (5, -8, 14)),
            *((4, -9, 16), (8, -7, 17), (13, -4, 17), (13, -3, 14)),
        ),
        (
            *((50, -42, -10), (60, -44, -14), (65, -42, -14), (60, -34, -14)),
            *((50, -30, -10), (40, -30, -4), (20, -28, 6), (30, -36, -2)),
        ),
    ),
}

# Of a right hand with the fingers up and the palm away from the person; columns are the hand's own axes.
_R_WORLD_FROM_RAISED = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])


class HandsAtTime(NamedTuple):
    """Both hands, in the order of `SIDES`; metres, world frame."""

    pose: Float[Array, "hand 16 3"]
    translation: Float[Array, "hand 3"]
    vertices_world: Float[Array, "hand 778 3"]
    joints_world: Float[Array, "hand 21 3"]


def hands_at(time_s: float) -> HandsAtTime:
    """Return both hands at a time, rounded to float32; everything else is built on that.

    Args:
        time_s: seconds since the take began; the motion repeats every `PERIOD_S`.
    """
    poses, places, meshes = [], [], []
    for side in SIDES:
        pose, wrist = _right_hand(side, time_s)
        if side == "left":
            pose, wrist = mirror_pose(pose), wrist * [-1.0, 1.0, 1.0]
        pose, hand = pose.astype(np.float32), default_hand(side)
        at_origin = hand_mesh(hand, np.zeros_like(pose), SHAPE).joints[WRIST]
        place = (wrist - at_origin).astype(np.float32)
        poses.append(pose)
        places.append(place)
        meshes.append(hand_mesh(hand, pose, SHAPE, place))
    vertices, joints = (
        np.stack([np.asarray(getattr(mesh, name), np.float32) for mesh in meshes])
        for name in ("vertices", "joints")
    )
    return HandsAtTime(np.stack(poses), np.stack(places), vertices, joints)


def finger_angles(side: str, time_s: float) -> Float[Array, "15 3"]:
    """Return flexion, abduction and twist of every joint (`hand.joint_limits`) at a time, radians."""
    curve = _angle_curve(side)
    late = time_s - np.array([_LAG_S[name] for name in MANO_FINGER_NAMES])
    angles = np.stack([curve(at % PERIOD_S)[finger] for finger, at in enumerate(late)])
    return angles.reshape(15, 3)


def _right_hand(side: str, time_s: float) -> tuple[Array, Array]:
    """Return pose (16, 3) and wrist (3,) of a hand as if it were a right one."""
    pose = angles_to_pose(finger_angles(side, time_s))
    place, turn = _wrist_curves(side)
    about, tip, lean = np.radians(turn(time_s % PERIOD_S))
    R = Rotation.from_euler("zxy", [about, tip, lean]).as_matrix() @ _R_WORLD_FROM_RAISED
    pose[WRIST] = Rotation.from_matrix(R).as_rotvec()
    return pose, place(time_s % PERIOD_S) / 100


@cache
def _angle_curve(side: str) -> PchipInterpolator:
    """Return the joint angles (finger, joint and angle) over time; without overshoot, so that limits hold."""
    postures = _PARTS[side].postures
    keys = np.stack([_angles(posture) for posture in postures])
    step = PERIOD_S / len(keys)
    # One period before and one after, so that the curve closes smoothly.
    times = step * np.arange(-len(keys), 2 * len(keys))
    return PchipInterpolator(times, np.tile(keys, (3, 1, 1)))


@cache
def _wrist_curves(side: str) -> tuple[CubicSpline, CubicSpline]:
    part = _PARTS[side]
    times = np.linspace(0, PERIOD_S, len(part.place_cm) + 1)
    place, turn = (
        CubicSpline(times, [*keys, keys[0]], bc_type="periodic") for keys in (part.place_cm, part.turn_deg)
    )
    return place, turn


def _angles(posture: Posture) -> Float[Array, "5 9"]:
    """Return angles as `hand.joint_limits` has them, fingers in MANO's order, within the limits."""
    angles = np.zeros((5, 3, 3))
    for finger, name in enumerate(MANO_FINGER_NAMES):
        if name == "thumb":
            angles[finger, 0] = posture[name][:3]
            angles[finger, 1:, 0] = posture[name][3:]
        else:
            angles[finger, 0, :2] = posture[name][:2]
            angles[finger, 1:, 0] = posture[name][2:]
    low, high = np.moveaxis(POSE_LIMITS.reshape(5, 3, 3, 2), -1, 0)
    return np.clip(np.radians(angles), low, high).reshape(5, 9)
