"""`<hand>.bvh`: the moving skeleton of each hand, in metres, y up, at a constant rate.

A frame without the hand repeats the last one that has it. Frames that do not come at even times are
drawn anew at the usual rate, turns along the shortest way.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from poem_jax.capture.outputs.motion import HandMotion, TakeMotion, seconds_per_frame
from poem_jax.hand.bones import rest_keypoints
from poem_jax.hand.topology import (
    FINGER_JOINTS,
    MANO_PARENTS,
    SKELETON_FROM_OPENPOSE,
    SKELETON_JOINT_NAMES,
)
from poem_jax.io.bvh import BvhSkeleton, write_bvh
from poem_jax.typing import Array, Bool, Float, Int

_UNEVEN = 0.01
"""Share of the usual step by which a step may differ from it."""


def write_skeleton(path: Path, hand: HandMotion, take: TakeMotion) -> Path:
    """Write the skeleton of a hand that is seen, and has one, in the take."""
    moving = hand.skeleton
    assert moving is not None
    held = held_frames(hand.seen)
    rotations = moving.rotations[held].astype(np.float64)
    rotations[:, 0] = take.R_upright_from_world @ rotations[:, 0]
    root = take.upright(moving.wrist[held])
    step = seconds_per_frame(take.time_s)
    if np.abs(np.diff(take.time_s) - step).max(initial=0) > _UNEVEN * step:
        even = np.arange(take.time_s[0], take.time_s[-1] + step / 2, step)
        even = np.minimum(even, take.time_s[-1])
        root = np.stack([np.interp(even, take.time_s, axis) for axis in root.T], -1)
        rotations = np.stack([_at(even, take.time_s, turns) for turns in np.moveaxis(rotations, 1, 0)], 1)
    return write_bvh(path, _at_rest(hand), root, rotations, step)


def held_frames(seen: Bool[Array, " frame"]) -> Int[np.ndarray, " frame"]:
    """Return for each frame the last one up to it in which the hand is seen; before that, the first."""
    numbers = np.where(seen, np.arange(len(seen)), -1)
    last = np.maximum.accumulate(numbers)
    return np.where(last < 0, np.argmax(seen), last)


def _at(even: Array, time_s: Array, turns: Float[Array, "frame 3 3"]) -> Float[Array, "even 3 3"]:
    return Slerp(time_s, Rotation.from_matrix(turns))(even).as_matrix()


def _at_rest(hand: HandMotion) -> BvhSkeleton:
    moving = hand.skeleton
    assert moving is not None
    points = rest_keypoints(moving.hand, moving.shape)
    joints = points[np.array(SKELETON_FROM_OPENPOSE)]
    offsets = joints - joints[np.array(MANO_PARENTS)]
    last = {finger[2]: points[finger[3]] - points[finger[2]] for finger in FINGER_JOINTS}
    ends = {SKELETON_FROM_OPENPOSE.index(joint): end for joint, end in last.items()}
    names = [f"{hand.name}_{joint}" for joint in SKELETON_JOINT_NAMES]
    return BvhSkeleton(names, MANO_PARENTS, offsets, ends)
