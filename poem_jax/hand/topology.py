"""Counts, joint orders, finger tips and query layouts of a hand in MANO's schema. Nothing else knows them.

Two joint orders exist. The 16 skeleton joints come in MANO's order (wrist; index, middle, little, ring,
thumb, each from the palm outwards). The 21 key points come in OpenPose's order (wrist; thumb, index,
middle, ring, little, each from the palm to the tip). Two sets of finger-tip vertices exist too: the one
that MANO's layer appends to its skeleton, and the one that goes with joints regressed from posed vertices.
"""

import enum
from typing import Final

import numpy as np

from poem_jax.typing import Array, Float, array_namespace

NUM_VERTICES: Final = 778
NUM_FACES: Final = 1538
NUM_SKELETON_JOINTS: Final = 16
"""Joints that rotate: wrist and three per finger, in MANO's order."""
NUM_JOINTS: Final = 21
"""Key points: the skeleton and five finger tips, in OpenPose's order."""
NUM_QUERIES: Final = NUM_VERTICES + NUM_JOINTS
NUM_SHAPES: Final = 10
NUM_POSE_FEATURES: Final = 9 * (NUM_SKELETON_JOINTS - 1)
NUM_WRIST_EDGES: Final = 16
"""Length of the one boundary loop: V - E + F = 1 with 778 vertices and 1538 triangles leaves 16 edges."""
NUM_FINGERS: Final = 5

WRIST: Final = 0
ROOT_JOINT: Final = 9
"""The joint (OpenPose order) at which models centre a hand: MCP of the middle finger."""

FINGER_NAMES: Final = ("thumb", "index", "middle", "ring", "little")
"""OpenPose order of the fingers."""
MANO_FINGER_NAMES: Final = ("index", "middle", "little", "ring", "thumb")
"""MANO's order of the fingers."""
FINGER_JOINTS: Final = tuple(tuple(range(4 * f + 1, 4 * f + 5)) for f in range(NUM_FINGERS))
"""The four key points of each finger, from the palm to the tip; fingers in OpenPose's order."""
PALM_JOINTS: Final = (WRIST, *(finger[0] for finger in FINGER_JOINTS))
"""Wrist, thumb base and knuckles: key points that are rigid, whatever the pose."""
INDEX_KNUCKLE: Final = FINGER_JOINTS[1][0]
LITTLE_KNUCKLE: Final = FINGER_JOINTS[4][0]
SKELETON_FINGERS: Final = tuple(tuple(range(3 * f + 1, 3 * f + 4)) for f in range(NUM_FINGERS))
"""The three skeleton joints of each finger, from the palm outwards; fingers in MANO's order."""
MANO_PARENTS: Final = (-1, *(parent for chain in SKELETON_FINGERS for parent in (WRIST, *chain[:-1])))
JOINT_NAMES: Final = (
    "wrist",
    *("thumb_cmc", "thumb_mcp", "thumb_ip", "thumb_tip"),
    *(f"{finger}_{joint}" for finger in FINGER_NAMES[1:] for joint in ("mcp", "pip", "dip", "tip")),
)
"""Names of the 21 key points."""
OPENPOSE_FROM_MANO: Final = (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20)
"""Where each key point stands in the list [16 skeleton joints, 5 tips thumb..little]."""
SKELETON_FROM_OPENPOSE: Final = (0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3)
"""Where each skeleton joint (MANO order) stands among the 21 key points."""
SKELETON_JOINT_NAMES: Final = tuple(JOINT_NAMES[i] for i in SKELETON_FROM_OPENPOSE)

TIP_VERTICES_LAYER: Final = (745, 317, 444, 556, 673)
"""Tips (thumb..little) appended to the skeleton of a right hand."""
TIP_VERTICES_LAYER_LEFT: Final = (745, 317, 445, 556, 673)
TIP_VERTICES_REGRESSED: Final = (744, 320, 443, 555, 672)
"""Tips (thumb..little) appended to joints regressed from posed vertices."""

BONES: Final = tuple(
    bone for finger in FINGER_JOINTS for bone in zip((WRIST, *finger[:-1]), finger, strict=True)
)
"""The 20 (parent, child) pairs of key points, finger by finger."""


class QueryOrder(enum.StrEnum):
    """The layout of the 799 query points."""

    VERTICES_FIRST = "vertices_first"
    """[vertices, joints], as the paper writes them."""
    JOINTS_FIRST = "joints_first"
    """[joints, vertices], as the released models have them."""


def join_queries(
    vertices: Float[Array, "*batch 778 c"], joints: Float[Array, "*batch 21 c"], order: QueryOrder
) -> Float[Array, "*batch 799 c"]:
    """Lay out vertices and joints as queries in the given order."""
    join = join_vertices_first if order is QueryOrder.VERTICES_FIRST else join_joints_first
    return join(vertices, joints)


def split_queries(
    queries: Float[Array, "*batch 799 c"], order: QueryOrder
) -> tuple[Float[Array, "*batch 778 c"], Float[Array, "*batch 21 c"]]:
    """Undo `join_queries`: return (vertices, joints)."""
    split = split_vertices_first if order is QueryOrder.VERTICES_FIRST else split_joints_first
    return split(queries)


def join_vertices_first(
    vertices: Float[Array, "*batch 778 c"], joints: Float[Array, "*batch 21 c"]
) -> Float[Array, "*batch 799 c"]:
    """Lay out the queries as [vertices, joints], as the paper writes them."""
    return array_namespace(vertices, joints).concatenate([vertices, joints], axis=-2)


def split_vertices_first(
    queries: Float[Array, "*batch 799 c"],
) -> tuple[Float[Array, "*batch 778 c"], Float[Array, "*batch 21 c"]]:
    """Undo `join_vertices_first`: return (vertices, joints)."""
    return queries[..., :NUM_VERTICES, :], queries[..., NUM_VERTICES:, :]


def join_joints_first(
    vertices: Float[Array, "*batch 778 c"], joints: Float[Array, "*batch 21 c"]
) -> Float[Array, "*batch 799 c"]:
    """Lay out the queries as [joints, vertices], as the released model does."""
    return array_namespace(vertices, joints).concatenate([joints, vertices], axis=-2)


def split_joints_first(
    queries: Float[Array, "*batch 799 c"],
) -> tuple[Float[Array, "*batch 778 c"], Float[Array, "*batch 21 c"]]:
    """Undo `join_joints_first`: return (vertices, joints), in this order too."""
    return queries[..., NUM_JOINTS:, :], queries[..., :NUM_JOINTS, :]


def openpose_joints(
    skeleton: Float[Array, "*batch 16 3"], tips: Float[Array, "*batch 5 3"]
) -> Float[Array, "*batch 21 3"]:
    """Put 16 skeleton joints (MANO order) and five tips (thumb..little) into OpenPose's order."""
    joints = array_namespace(skeleton, tips).concatenate([skeleton, tips], axis=-2)
    return joints[..., np.array(OPENPOSE_FROM_MANO), :]
