"""How much each of the 21 key points says about each vertex: numbers of joints drawn as colours of a mesh.

A vertex belongs to skeleton joints by its skin weights. Each of these carries the bones that begin there, and
on them the vertex lies between the joint and the bones' far ends, to which its share goes by the inverse
square of the distance in the resting hand.
"""

import numpy as np

from poem_jax.hand.topology import (
    BONES,
    NUM_SKELETON_JOINTS,
    SKELETON_FROM_OPENPOSE,
    TIP_VERTICES_LAYER,
    openpose_joints,
)
from poem_jax.typing import Array, Float

_NEAREST_M = 0.002
"""Distances below it count as it."""


def vertex_joint_weights(
    v_template: Float[Array, "778 3"], J_regressor: Float[Array, "16 778"], weights: Float[Array, "778 16"]
) -> Float[Array, "778 21"]:
    """Return each vertex's weights of the 21 key points, at least 0; rows sum to 1.

    Args:
        v_template, J_regressor, weights: Of a hand of either side in MANO's schema (`HandModel`); concrete.
    """
    v_template, J_regressor = np.asarray(v_template, np.float64), np.asarray(J_regressor, np.float64)
    joints = openpose_joints(J_regressor @ v_template, v_template[list(TIP_VERTICES_LAYER)])
    distances = np.linalg.norm(v_template[:, None] - joints, axis=-1)
    nearness = 1 / np.maximum(distances, _NEAREST_M) ** 2
    shares = np.zeros(nearness.shape)
    for skeleton_joint in range(NUM_SKELETON_JOINTS):
        start = SKELETON_FROM_OPENPOSE[skeleton_joint]
        ends = [start, *(child for parent, child in BONES if parent == start)]
        near = nearness[:, ends]
        shares[:, ends] += np.asarray(weights)[:, skeleton_joint, None] * near / near.sum(-1, keepdims=True)
    return shares / shares.sum(-1, keepdims=True)
