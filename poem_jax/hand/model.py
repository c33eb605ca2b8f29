"""One hand model in MANO's schema, in stages: load -> shape -> pose -> skin (Romero et al. 2017, MANO).

Every stage is a stateless tuple that holds what the next one needs. All of it follows the array type: NumPy
in, NumPy out; JAX in, JAX out, differentiable and with any leading batch axes. JAX is not imported here.

Letters: J = 16 skeleton joints in MANO's order; betas = shape coefficients, about N(0, 1); pose =
axis-angle per skeleton joint relative to its parent, radians, joint 0 turning the whole hand about its
wrist joint; zero pose = flat hand (no mean pose is added). Lengths are metres.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.geometry.transforms import matmul, rotation_from_axis_angle
from poem_jax.hand.topology import (
    NUM_POSE_FEATURES,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    NUM_VERTICES,
    ROOT_JOINT,
    SKELETON_FINGERS,
    TIP_VERTICES_LAYER,
    TIP_VERTICES_LAYER_LEFT,
    TIP_VERTICES_REGRESSED,
    QueryOrder,
    join_queries,
    openpose_joints,
)
from poem_jax.typing import Array, Bool, Float, Int, array_namespace

_MIRROR_SIGN = np.array([-1.0, 1.0, 1.0], dtype=np.float32)


class HandMesh(NamedTuple):
    """A posed hand."""

    vertices: Float[Array, "*batch 778 3"]
    """Metres, MANO numbering."""
    joints: Float[Array, "*batch 21 3"]
    """Metres, OpenPose order: skeleton joints and the layer's tip vertices."""


class HandModel(NamedTuple):
    """The arrays of a hand, under MANO's names."""

    v_template: Float[Array, "778 3"]
    """Rest vertices of the mean shape, metres."""
    shapedirs: Float[Array, "778 3 10"]
    """Displacement per unit of each shape coefficient."""
    posedirs: Float[Array, "778 3 135"]
    """Displacement per entry of (R - I) of joints 1..15, row-major."""
    J_regressor: Float[Array, "16 778"]
    """Skeleton joints from rest vertices; rows sum to 1."""
    weights: Float[Array, "778 16"]
    """Skin weights; rows sum to 1."""
    faces: Int[Array, "1538 3"]
    """Triangles, counter-clockwise seen from outside."""
    is_left: Bool[Array, ""]

    @property
    def side(self) -> str:
        """`"left"` or `"right"`; concrete models only."""
        return "left" if bool(self.is_left) else "right"

    def shape(self, betas: Float[Array, "*batch 10"]) -> "ShapedHand":
        """Give the resting hand its proportions; `betas` are about N(0, 1)."""
        directions = self.shapedirs.reshape(NUM_VERTICES * 3, NUM_SHAPES)
        offsets = matmul(betas, directions.T)
        vertices = self.v_template + offsets.reshape(*betas.shape[:-1], NUM_VERTICES, 3)
        return ShapedHand(self, vertices, matmul(self.J_regressor, vertices))


class ShapedHand(NamedTuple):
    """A hand of given proportions, at rest."""

    model: HandModel
    vertices: Float[Array, "*batch 778 3"]
    skeleton: Float[Array, "*batch 16 3"]
    """Joints at rest, MANO order."""

    def pose(self, pose: Float[Array, "*batch 16 3"]) -> "PosedHand":
        """Bend the skeleton by axis-angle vectors (radians, MANO order, relative to the parent joint)."""
        return self.pose_rotations(rotation_from_axis_angle(pose))

    def pose_rotations(self, rotations: Float[Array, "*batch 16 3 3"]) -> "PosedHand":
        """Bend the skeleton by rotation matrices; the batch axes broadcast against those of the shape."""
        model = self.model
        batch = rotations.shape[:-3]
        identity = np.eye(3, dtype=np.float32)
        features = (rotations[..., 1:, :, :] - identity).reshape(*batch, NUM_POSE_FEATURES)
        directions = model.posedirs.reshape(NUM_VERTICES * 3, NUM_POSE_FEATURES)
        offsets = matmul(features, directions.T).reshape(*batch, NUM_VERTICES, 3)
        turned, positions = forward_kinematics(rotations, self.skeleton)
        return PosedHand(model, self.vertices + offsets, self.skeleton, turned, positions)


class PosedHand(NamedTuple):
    """A bent skeleton and the resting surface that will follow it."""

    model: HandModel
    rest_vertices: Float[Array, "*batch 778 3"]
    """Shaped vertices with the pose correction, before skinning."""
    rest_skeleton: Float[Array, "*batch 16 3"]
    rotations: Float[Array, "*batch 16 3 3"]
    """R_world_from_joint: every joint's rotation, composed along its chain."""
    skeleton: Float[Array, "*batch 16 3"]
    """Posed joints, MANO order."""

    def skin(self) -> HandMesh:
        """Carry the surface along by linear blend skinning (Romero et al. 2017, eq. 2)."""
        model, xp = self.model, array_namespace(*self.model, *self[1:])
        offset = self.skeleton - _rotate(self.rotations, self.rest_skeleton)
        batch = offset.shape[:-2]
        turns = xp.broadcast_to(self.rotations, (*batch, NUM_SKELETON_JOINTS, 3, 3))
        transforms = xp.concatenate([turns, offset[..., None]], axis=-1)
        blended = matmul(model.weights, transforms.reshape(*batch, NUM_SKELETON_JOINTS, 12))
        blended = blended.reshape(*batch, NUM_VERTICES, 3, 4)
        vertices = _rotate(blended[..., :3], self.rest_vertices) + blended[..., 3]
        return HandMesh(vertices, openpose_joints(self.skeleton, vertices[..., layer_tips(model), :]))


def hand_mesh(
    model: HandModel,
    pose: Float[Array, "*batch 16 3"],
    shape: Float[Array, "*batch 10"],
    translation: Float[Array, "*batch 3"] | None = None,
    center_joint: int | None = None,
) -> HandMesh:
    """Run all stages: shape, pose, skin, then place the hand.

    Args:
        model: the hand.
        pose: axis-angle per skeleton joint, radians, MANO order; row 0 turns the hand about its wrist joint.
        shape: shape coefficients, about N(0, 1).
        translation: metres, added last; None = nothing.
        center_joint: key point (OpenPose order) moved to the origin before `translation`; None leaves the
            wrist where the shaped template has it.

    Returns: vertices and 21 joints, metres, in the frame that `pose[..., 0, :]` turns into.
    """
    mesh = model.shape(shape).pose(pose).skin()
    if center_joint is not None:
        mesh = _moved(mesh, -mesh.joints[..., center_joint, :])
    return mesh if translation is None else _moved(mesh, translation)


def joints_from_vertices(
    model: HandModel, vertices: Float[Array, "*batch 778 3"]
) -> Float[Array, "*batch 21 3"]:
    """Read 21 key points (OpenPose order) off posed vertices: regressed joints and the second tip set."""
    skeleton = matmul(model.J_regressor, vertices)
    return openpose_joints(skeleton, vertices[..., np.array(TIP_VERTICES_REGRESSED), :])


def layer_tips(model: HandModel) -> Int[Array, "5"]:
    """Return the tip vertices (thumb..little) of the model's side."""
    xp = array_namespace(model.is_left)
    return xp.where(model.is_left, np.array(TIP_VERTICES_LAYER_LEFT), np.array(TIP_VERTICES_LAYER))


def mirror(model: HandModel) -> HandModel:
    """Return the other hand: reflected in the Y-Z plane, faces turned to stay outward.

    With `mirror_pose`, hand_mesh(mirror(m), mirror_pose(p), s) is the reflection of hand_mesh(m, p, s).
    """
    sign = _MIRROR_SIGN
    feature_sign = np.tile(np.outer(sign, sign).ravel(), NUM_SKELETON_JOINTS - 1)
    return model._replace(
        v_template=model.v_template * sign,
        shapedirs=model.shapedirs * sign[:, None],
        posedirs=model.posedirs * sign[:, None] * feature_sign,
        faces=model.faces[:, ::-1],
        is_left=~model.is_left,
    )


def mirror_pose(pose: Float[Array, "*batch joint 3"]) -> Float[Array, "*batch joint 3"]:
    """Reflect axis-angle vectors in the Y-Z plane (a rotation axis is a pseudo-vector)."""
    return pose * -_MIRROR_SIGN


def forward_kinematics(
    rotations: Float[Array, "*batch 16 3 3"], skeleton: Float[Array, "*rest 16 3"]
) -> tuple[Float[Array, "*batch 16 3 3"], Float[Array, "*posed 16 3"]]:
    """Compose rotations and positions from the wrist outwards, the five fingers side by side.

    Args:
        rotations: R_parent_from_joint, MANO order; the batch axes of both arguments broadcast.
        skeleton: joints at rest, metres.

    Returns: R_world_from_joint, and the posed joints; the wrist stays where it was.
    """
    xp = array_namespace(rotations, skeleton)
    turned, placed = [], []
    turn = rotations[..., None, 0, :, :]
    place, rest = skeleton[..., None, 0, :], skeleton[..., None, 0, :]
    wrist = (turn, place)
    for joints in np.array(SKELETON_FINGERS).T:
        place = place + _rotate(turn, skeleton[..., joints, :] - rest)
        rest = skeleton[..., joints, :]
        turn = matmul(turn, rotations[..., joints, :, :])
        turned.append(turn)
        placed.append(place)
    batch_turn, batch_place = turn.shape[:-3], place.shape[:-2]
    fingers = NUM_SKELETON_JOINTS - 1
    turns = xp.stack(turned, axis=-3).reshape(*batch_turn, fingers, 3, 3)
    places = xp.stack(placed, axis=-2).reshape(*batch_place, fingers, 3)
    wrist_place = xp.broadcast_to(wrist[1], (*batch_place, 1, 3))
    return xp.concatenate([wrist[0], turns], axis=-3), xp.concatenate([wrist_place, places], axis=-2)


def _rotate(matrices: Array, vectors: Array) -> Array:
    """Multiply (..., 3, 3) by (..., 3); as a plain sum, which every device computes in full precision."""
    return (matrices * vectors[..., None, :]).sum(-1)


def _moved(mesh: HandMesh, offset: Float[Array, "*batch 3"]) -> HandMesh:
    return HandMesh(mesh.vertices + offset[..., None, :], mesh.joints + offset[..., None, :])


def template_queries(
    hand: HandModel, order: QueryOrder, *, center_joint: int = ROOT_JOINT
) -> Float[Array, "799 3"]:
    """Return the flat mean hand about its root joint, or another (OpenPose order), metres."""
    dtype = hand.v_template.dtype
    zero_pose, mean_shape = np.zeros((NUM_SKELETON_JOINTS, 3), dtype), np.zeros(NUM_SHAPES, dtype)
    return join_queries(*hand_mesh(hand, zero_pose, mean_shape, center_joint=center_joint), order)
