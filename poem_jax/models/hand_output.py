"""The hand that the decoder starts from and the hand that parametric models give.

Query points start at the hand template, or at the template posed by the triangulated joints: the palm turns
with the frame spanned by wrist and knuckles, every finger bone turns by the smallest rotation that brings it
from its parent's turn to its observed direction, and the surface follows by skinning. Joints are taken as
they are, so that proportions follow too.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.geometry.transforms import matmul, rotation_from_6d, smallest_rotation, transpose
from poem_jax.hand.model import HandMesh, HandModel, PosedHand
from poem_jax.hand.topology import (
    NUM_QUERIES,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    ROOT_JOINT,
    SKELETON_FROM_OPENPOSE,
    WRIST,
    QueryOrder,
    join_queries,
    split_queries,
)
from poem_jax.models.layers import Exact, linear
from poem_jax.typing import Array, Bool, Float

_SKELETON = np.array(SKELETON_FROM_OPENPOSE, np.int32)
_CHAINS = np.arange(1, NUM_SKELETON_JOINTS, dtype=np.int32).reshape(5, 3)
_KNUCKLES = np.array([5, 9, 13, 17], np.int32)
_ACROSS = np.array([1.0, 0.5, -0.5, -1.0])
"""Weights of the knuckles (index to little) for the direction across the palm."""
_IDENTITY_6D = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_SMALL = 1e-2
"""Scale of the first weights: training starts near the flat mean hand."""
_MAX_JOINT_DISTANCE = 1.5
"""Basis radii. Triangulated joints farther from the root are drawn in before they pose the template."""


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
    palm = matmul(transpose(palm_frame(joints)), palm_frame(template_joints))
    turns = _bone_turns(palm, template_joints, joints)
    rest = template_joints[_SKELETON]
    return PosedHand(hand, template_vertices, rest, turns, joints[..., _SKELETON, :]).skin().vertices


def palm_frame(joints: Float[Array, "*batch 21 3"]) -> Float[Array, "*batch 3 3"]:
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


def first_queries(
    hand: HandModel,
    template: Float[Array, "799 3"],
    joints: Float[Array, "batch 21 3"],
    solved: Bool[Array, " batch"],
    radius: float,
    order: QueryOrder,
) -> Float[Array, "batch 799 3"]:
    """Return the template posed by the joints, metres about the root; the template where they are not
    `solved`. Joints farther than 1.5 basis radii from the root are drawn in."""
    joints = draw_in(joints, radius)
    posed = pose_by_joints(hand, *split_queries(template, order), joints)
    return jnp.where(solved[:, None, None], join_queries(posed, joints, order), template)


def draw_in(joints: Float[Array, "*batch 3"], radius: float) -> Float[Array, "*batch 3"]:
    """Bring joints about the root that are farther from it than 1.5 basis radii to that distance."""
    square = jnp.sum(joints**2, -1, keepdims=True)
    return joints * jnp.minimum(1.0, _MAX_JOINT_DISTANCE * radius * jax.lax.rsqrt(jnp.maximum(square, 1e-12)))


class HandParameters(NamedTuple):
    """What a parametric decoder regresses."""

    rotations: Float[Array, "batch 16 3 3"]
    """Of each skeleton joint relative to its parent, MANO order; the first turns into the primary camera."""
    shape: Float[Array, "batch 10"]


class ParameterRegressor(nnx.Module):
    """Learned pooling over the queries, then one linear layer to 16 6D rotations and 10 coefficients."""

    def __init__(self, width: int, *, row_major: bool = False, rngs: nnx.Rngs) -> None:
        """`row_major`: (query, channel) in memory is read as (channel, query), as the release does."""
        self.row_major = row_major
        self.pool = linear(NUM_QUERIES, 1, rngs=rngs)
        numbers = NUM_SKELETON_JOINTS * len(_IDENTITY_6D) + NUM_SHAPES
        self.regress = linear(width, numbers, exact=True, rngs=rngs)
        self.regress.kernel = Exact(_SMALL * self.regress.kernel[...])
        flat_hand = jnp.concatenate(
            [jnp.tile(jnp.array(_IDENTITY_6D), NUM_SKELETON_JOINTS), jnp.zeros(NUM_SHAPES)]
        )
        self.regress.bias = Exact(flat_hand)

    def __call__(self, embeddings: Float[Array, "batch query c"]) -> HandParameters:
        """Regress the parameters."""
        if self.row_major:
            channels = embeddings.reshape(embeddings.shape[0], embeddings.shape[-1], NUM_QUERIES)
        else:
            channels = jnp.swapaxes(embeddings, -1, -2)
        numbers = self.regress(self.pool(channels)[..., 0])
        sixd, shape = jnp.split(numbers, [NUM_SKELETON_JOINTS * len(_IDENTITY_6D)], -1)
        return HandParameters(
            rotation_from_6d(sixd.reshape(-1, NUM_SKELETON_JOINTS, len(_IDENTITY_6D))), shape
        )


def root_relative_mesh(hand: HandModel, parameters: HandParameters) -> HandMesh:
    """Return the hand about its root joint, metres."""
    mesh = hand.shape(parameters.shape).pose_rotations(parameters.rotations).skin()
    root = mesh.joints[..., ROOT_JOINT, None, :]
    return HandMesh(mesh.vertices - root, mesh.joints - root)
