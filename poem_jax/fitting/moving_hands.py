"""Hands between two moments: what the smoothing of a take and the bridging of its gaps are made of.

A hand moves as it is built: rotations along the shortest arc, places along straight lines. Half of the way
from a to b is half of the way from b to a; moving both by a rigid motion of the world moves every hand
between them likewise.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from poem_jax.geometry.alignment import procrustes
from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    matmul,
    rotate_points,
    rotation_from_axis_angle,
    transpose,
)
from poem_jax.hand.model import HandMesh, HandModel, ShapedHand, forward_kinematics, layer_tips
from poem_jax.hand.topology import (
    FINGER_NAMES,
    MANO_FINGER_NAMES,
    MANO_PARENTS,
    OPENPOSE_FROM_MANO,
    SKELETON_FINGERS,
    WRIST,
)
from poem_jax.typing import Array, Float


@runtime_checkable
class MovingHand(Protocol):
    """A hand at one moment, in the world, metres."""

    @property
    def markers(self) -> Float[np.ndarray, "joint 3"]:
        """Points by which its motion is measured."""
        ...

    def towards(self, other: Any, share: float) -> Any:
        """Return the hand that lies `share` of the way (0 to 1) from this one to another of its kind."""
        ...


Hand = TypeVar("Hand", bound=MovingHand)


@dataclass(frozen=True)
class MeshHand:
    """A hand of points alone: it moves rigidly as its joints say, and what is left deforms linearly."""

    joints: Float[np.ndarray, "joint 3"]
    points: Float[np.ndarray, "point 3"]
    """Carried along with the joints; there may be none."""

    @property
    def markers(self) -> Float[np.ndarray, "joint 3"]:
        """See `MovingHand`: the joints."""
        return self.joints

    def towards(self, other: "MeshHand", share: float) -> "MeshHand":
        """See `MovingHand`. Of a rigid motion M from a to b: M^s ((1 - s) a + s M^-1 b)."""
        R = procrustes(self.joints, other.joints, with_scale=False).R
        begin, end = self.joints.mean(0), other.joints.mean(0)
        turn = rotation_from_axis_angle(share * axis_angle_from_rotation(R))
        place = begin + share * (end - begin)

        def moved(a: Array, b: Array) -> Array:
            returned = rotate_points(R.T, b - end)
            return rotate_points(turn, a - begin + share * (returned - (a - begin))) + place

        return MeshHand(moved(self.joints, other.joints), moved(self.points, other.points))


_LAST_BONES = np.array([SKELETON_FINGERS[MANO_FINGER_NAMES.index(name)][-1] for name in FINGER_NAMES])
"""The skeleton joints (MANO order) that carry the tips, thumb to little."""
_CARRIERS = np.array([*(max(parent, WRIST) for parent in MANO_PARENTS), *_LAST_BONES])[
    list(OPENPOSE_FROM_MANO)
]
"""The skeleton joint whose bone carries each key point (OpenPose order)."""


@dataclass(frozen=True)
class ModelHand:
    """A hand model in a pose: rotations, shape and place move, the surface follows."""

    model: HandModel
    rotations: Float[np.ndarray, "16 3 3"]
    """R_parent_from_joint, MANO order; the first turns into the world."""
    shape: Float[np.ndarray, "10"]
    wrist: Float[np.ndarray, "3"]
    offsets: Float[np.ndarray, "21 3"] | None = None
    """From the joints to where a detector sees them, in the frames of the bones that carry them."""

    @classmethod
    def posed(
        cls,
        model: HandModel,
        pose: Float[Array, "16 3"],
        shape: Float[Array, "10"],
        translation: Float[Array, "3"],
        expected_from_joints: Float[Array, "21 3"] | None = None,
    ) -> "ModelHand":
        """Make the hand of `hand_mesh(model, pose, shape, translation)`.

        Args:
            model: The hand.
            pose: Axis-angle, radians.
            shape: Coefficients.
            translation: Metres.
            expected_from_joints: From each joint to where the detector should see it, metres, world; None =
                at the joints.
        """
        pose, shape, translation = (np.asarray(x, np.float64) for x in (pose, shape, translation))
        wrist = model.shape(shape).skeleton[WRIST] + translation
        hand = cls(model, rotation_from_axis_angle(pose), shape, wrist)
        if expected_from_joints is None:
            return hand
        offsets = rotate_points(transpose(hand._bones), expected_from_joints[:, None])[:, 0]
        return replace(hand, offsets=offsets)

    def towards(self, other: "ModelHand", share: float) -> "ModelHand":
        """See `MovingHand`."""
        turns = axis_angle_from_rotation(matmul(transpose(self.rotations), other.rotations))
        offsets = self.offsets
        if offsets is not None and other.offsets is not None:
            offsets = offsets + share * (other.offsets - offsets)
        return ModelHand(
            self.model,
            matmul(self.rotations, rotation_from_axis_angle(share * turns)),
            self.shape + share * (other.shape - self.shape),
            self.wrist + share * (other.wrist - self.wrist),
            offsets,
        )

    @property
    def markers(self) -> Float[np.ndarray, "21 3"]:
        """See `MovingHand`: the skeleton, and the tips as if they were rigid with the last bones."""
        return self._markers

    @cached_property
    def _markers(self) -> Float[np.ndarray, "21 3"]:
        turns, skeleton = self._kinematics
        rest = self._shaped.vertices[layer_tips(self.model)] - self._shaped.skeleton[_LAST_BONES]
        tips = skeleton[_LAST_BONES] + rotate_points(turns[_LAST_BONES], rest[:, None])[:, 0]
        return np.concatenate([skeleton, tips]) + self.translation

    @cached_property
    def mesh(self) -> HandMesh:
        """The surface and the joints, metres, world."""
        mesh = self._shaped.pose_rotations(self.rotations).skin()
        return HandMesh(mesh.vertices + self.translation, mesh.joints + self.translation)

    @cached_property
    def translation(self) -> Float[np.ndarray, "3"]:
        """As `hand_mesh` takes it."""
        return self.wrist - self._shaped.skeleton[WRIST]

    @property
    def pose(self) -> Float[np.ndarray, "16 3"]:
        """Axis-angle, as `hand_mesh` takes it."""
        return axis_angle_from_rotation(self.rotations)

    @property
    def expected(self) -> Float[np.ndarray, "21 3"] | None:
        """Where the detector should see the joints; None = at them."""
        if self.offsets is None:
            return None
        return self.mesh.joints + rotate_points(self._bones, self.offsets[:, None])[:, 0]

    @cached_property
    def _shaped(self) -> ShapedHand:
        return self.model.shape(self.shape)

    @property
    def _bones(self) -> Float[np.ndarray, "21 3 3"]:
        """R_world_from_bone of the bone that carries each key point."""
        return self._kinematics[0][_CARRIERS]

    @cached_property
    def _kinematics(self) -> tuple[Float[np.ndarray, "16 3 3"], Float[np.ndarray, "16 3"]]:
        """R_world_from_joint, and the joints about the resting wrist."""
        return forward_kinematics(self.rotations, self._shaped.skeleton)
