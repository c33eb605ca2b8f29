"""What a model must beat: a hand that never moves, and the error of triangulation alone.

Frames: world as the samples give it; primary = the first camera's; hand = the world turned by the inverse of
the hand's global rotation, origin at the root joint.
"""

import jax
import numpy as np

from poem_jax.geometry.transforms import (
    invert_rigid,
    rotate_points,
    rotation_from_axis_angle,
    transform_points,
    transpose,
)
from poem_jax.geometry.triangulation import triangulate
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.typing import Array, Float

DLT_NOISE_PX = 2.0
"""Standard deviation per coordinate, in pixels of the crops, of the noise in `noisy_dlt_roots`."""

_triangulate = jax.jit(triangulate)


def mean_pose(
    vertices_world: Float[np.ndarray, "sample vert 3"],
    joints_world: Float[np.ndarray, "sample joint 3"],
    T_primary_from_world: Float[np.ndarray, "sample 4 4"],
) -> Float[np.ndarray, "sample vert 3"]:
    """Predict the same mesh for every sample, at its true root: the mean of these very samples.

    The mean is over root-relative vertices in the primary camera's frame: the best constant there in the
    sense of squares, and known only to the ground truth. The prediction knows the root and nothing of pose,
    shape or global rotation; where directions are uniform the mean is a hand shrunk towards its root.
    """
    vertices = transform_points(T_primary_from_world, vertices_world)
    root = transform_points(T_primary_from_world, joints_world[:, ROOT_JOINT, None])
    constant = (vertices - root).mean(0) + root
    return transform_points(invert_rigid(T_primary_from_world), constant)


def mean_pose_rotated(
    vertices_world: Float[np.ndarray, "sample vert 3"],
    joints_world: Float[np.ndarray, "sample joint 3"],
    global_rotation: Float[np.ndarray, "sample 3"],
) -> Float[np.ndarray, "sample vert 3"]:
    """Predict the mean hand, turned by the true global rotation (axis-angle `pose[:, 0]`), at the true root.

    Stronger than `mean_pose`: only finger pose and shape are unknown to it.
    """
    R_world_from_hand = rotation_from_axis_angle(global_rotation)
    root = joints_world[:, ROOT_JOINT, None]
    mean_hand = rotate_points(transpose(R_world_from_hand), vertices_world - root).mean(0)
    return rotate_points(R_world_from_hand, np.broadcast_to(mean_hand, vertices_world.shape)) + root


def noisy_dlt_roots(
    root_px: Float[Array, "sample view 2"],
    K: Float[Array, "sample view 3 3"],
    T_cam_from_world: Float[Array, "sample view 4 4"],
    noise: Float[np.ndarray, "sample view 2"],
) -> Float[np.ndarray, "sample 3"]:
    """Triangulate the true root pixels with `DLT_NOISE_PX` of noise: what the root costs with good heat maps.

    Args:
        root_px: true projections of the root joint.
        K: intrinsics of the crops.
        T_cam_from_world: extrinsics.
        noise: standard normal draws.

    Returns: roots in the world, metres; NaN where the views do not determine one.
    """
    points, valid = _triangulate((root_px + DLT_NOISE_PX * noise)[:, :, None], K, T_cam_from_world)
    return np.where(np.asarray(valid), np.asarray(points)[:, 0], np.nan)
