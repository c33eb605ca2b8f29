"""How the hands of a take move: one shape and the turns of 16 joints per hand.

An engine that fits a hand model gives the turns. Of one that gives meshes and joints alone, the shape is
found from the lengths of the bones, and the turns from their directions (`hand/bones.py`).
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from poem_jax.capture.frame_times import SECONDS_PER_FRAME
from poem_jax.geometry.transforms import rotate_points, rotation_from_axis_angle
from poem_jax.hand.bones import bone_lengths, rotations_of_joints, shape_of_bones
from poem_jax.hand.model import HandModel, ShapedHand
from poem_jax.hand.topology import WRIST
from poem_jax.typing import Array, Bool, Float

_LENGTHS_FROM = 500
"""Frames, spread over the take, of which the bones are measured."""

_log = logging.getLogger(__name__)


class HandMotion(NamedTuple):
    """One hand through a take."""

    name: str
    side: str
    seen: Bool[Array, " frame"]
    """Frames in which there is a result, bridged ones among them."""
    bridged: Bool[Array, " frame"]
    joints: Float[Array, "frame 21 3"]
    """Metres, the capture's axes, from the take's origin; NaN where not seen."""
    skeleton: "MovingSkeleton | None"
    """None where the hand is never seen, or no hand model is known."""


class MovingSkeleton(NamedTuple):
    """A hand model of one shape that follows the joints."""

    hand: HandModel
    shape: Float[Array, "10"]
    """One for the take."""
    rotations: Float[Array, "frame 16 3 3"]
    """Relative to the parent joints, MANO order; the wrist's R_world_from_rest; unit where not seen."""
    wrist: Float[Array, "frame 3"]
    """Place of the wrist joint, as `HandMotion.joints`; zero where not seen."""
    from_joints: bool
    """Whether shape and turns were found from the joints, for want of a pose."""

    @property
    def shaped(self) -> ShapedHand:
        """The hand at rest."""
        return self.hand.shape(np.asarray(self.shape))

    def vertices(self, frame: int) -> Float[np.ndarray, "778 3"]:
        """Return the skinned mesh of a frame, metres, as `HandMotion.joints`."""
        posed = self.shaped.pose_rotations(self.rotations[frame])
        return posed.skin().vertices + (self.wrist[frame] - posed.skeleton[0])


class TakeMotion(NamedTuple):
    """All hands of a take."""

    frames: Sequence[str]
    """Names."""
    time_s: Float[Array, " frame"]
    """Increasing."""
    hands: list[HandMotion]
    origin_world: Float[Array, "3"]
    """Where points of the motion are measured from, in the capture's world: its own origin, or where that is
    far away a point amidst the cameras, since programs that show animations compute in float32."""
    R_upright_from_world: Float[Array, "3 3"]
    """To axes of which y is up, for files that expect it."""

    def upright(self, points: Float[Array, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Return points of the motion, from its origin, in axes of which y is up."""
        flat = np.reshape(points, (-1, 3)).astype(np.float64)
        return rotate_points(self.R_upright_from_world, flat).reshape(np.shape(points))


def frame_times(time_s: Float[Array, " frame"]) -> Float[np.ndarray, " frame"]:
    """Return times that increase: those given, or 30 frames a second where these are not known (NaN).

    A warning says so where they are given and do not increase.
    """
    time_s = np.asarray(time_s, np.float64)
    known = np.isfinite(time_s)
    if known.all() and (np.diff(time_s) > 0).all():
        return time_s
    if known.any():
        _log.warning(
            "the times of the frames do not increase, or some are missing; animations and tables take %g "
            "frames a second",
            1 / SECONDS_PER_FRAME,
        )
    return SECONDS_PER_FRAME * np.arange(len(time_s))


def seconds_per_frame(time_s: Float[Array, " frame"]) -> float:
    """Return the usual time between frames."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else SECONDS_PER_FRAME


def take_motion(
    frames: Sequence[str],
    names: Sequence[str],
    sides: Sequence[str],
    array: Callable[[str], Array | None],
    hands: Mapping[str, HandModel] | None,
    origin_world: Float[Array, "3"],
    R_upright_from_world: Float[Array, "3 3"],
) -> TakeMotion:
    """Gather the motion of a take from what `prediction.npz` holds.

    Args:
        frames: Their names.
        names, sides: Of the hands.
        array: Gives the arrays of `prediction.npz` by name, None for those that are not there.
        hands: The hand models by side, of which poses and meshes are; None = not known.
        origin_world: What points are measured from.
        R_upright_from_world: From `geometry.upright`.
    """

    def given(name: str) -> Array:
        values = array(name)
        assert values is not None
        return values

    moving = []
    for index, (name, side) in enumerate(zip(names, sides, strict=True)):
        seen = np.array(given("valid")[:, index])
        joints = np.asarray(given("joints_world")[:, index] - origin_world, np.float32)
        skeleton = None
        if hands is not None and seen.any():
            pose, shape = array("pose"), array("shape")
            both = None if pose is None or shape is None else (pose[:, index], shape[:, index])
            hand = HandModel(*(np.asarray(field) for field in hands[side]))
            skeleton = _skeleton(hand, seen, joints, both)
        moving.append(HandMotion(name, side, seen, np.array(given("bridged")[:, index]), joints, skeleton))
    return TakeMotion(frames, frame_times(given("time_s")), moving, origin_world, R_upright_from_world)


def _skeleton(
    hand: HandModel,
    seen: Bool[Array, " frame"],
    joints: Float[Array, "frame 21 3"],
    pose_and_shape: tuple[Array, Array] | None,
) -> MovingSkeleton:
    rotations = np.tile(np.eye(3, dtype=np.float32), (len(seen), 16, 1, 1))
    wrist = np.where(seen[:, None], joints[:, WRIST], 0)
    if pose_and_shape is not None and all(np.isfinite(part[seen]).all() for part in pose_and_shape):
        pose, shape = pose_and_shape
        rotations[seen] = rotation_from_axis_angle(np.asarray(pose[seen], np.float64))
        return MovingSkeleton(hand, np.median(shape[seen], axis=0), rotations, wrist, False)
    some = np.flatnonzero(seen)[:: max(1, int(seen.sum()) // _LENGTHS_FROM)]
    shape = shape_of_bones(hand, np.median(bone_lengths(joints[some].astype(np.float64)), axis=0))
    rotations[seen] = rotations_of_joints(hand, shape, joints[seen])
    return MovingSkeleton(hand, shape, rotations, wrist, True)
