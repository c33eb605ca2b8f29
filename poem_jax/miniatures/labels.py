"""Labels of a planted frame in the forms that data sets store, computed from the truth alone."""

import numpy as np

from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    invert_rigid,
    quaternion_from_rotation,
    rotation_from_axis_angle,
    transform_points,
    transpose,
)
from poem_jax.hand.topology import FINGER_JOINTS, WRIST
from poem_jax.miniatures.scene import PlantedFrame
from poem_jax.typing import Array, Float

SMPLX_TIPS = (744, 320, 443, 554, 671)
"""Tip vertices (thumb..little) that smplx appends to MANO's skeleton (its `vertex_ids.py`)."""


def joints_world(frame: PlantedFrame) -> Float[Array, "21 3"]:
    """Return the joints in the rig's world, metres, OpenPose order."""
    return transform_points(invert_rigid(frame.T_cam_from_world[0]), frame.joints_cam[0])


def pose_world(frame: PlantedFrame) -> Float[Array, "16 3"]:
    """Return the pose whose first row turns the hand into the world, axis-angle, zero = flat hand."""
    pose = frame.pose_cam[0].copy()
    R_world_from_cam = transpose(frame.T_cam_from_world[0, :3, :3])
    pose[WRIST] = axis_angle_from_rotation(R_world_from_cam @ rotation_from_axis_angle(pose[WRIST]))
    return pose


def quaternions(pose: Float[Array, "*batch 16 3"]) -> Float[Array, "*batch 16 4"]:
    """Return a pose as unit quaternions wxyz."""
    return quaternion_from_rotation(rotation_from_axis_angle(pose))


def with_joints(frame: PlantedFrame, joints_cam: Float[Array, "view 21 3"]) -> PlantedFrame:
    """Return the frame with other joints, and the key points that belong to them."""
    return frame._replace(joints_cam=joints_cam, keypoints_px=project_cam(frame.K, joints_cam))


def with_smplx_tips(frame: PlantedFrame) -> PlantedFrame:
    """Return the frame with the finger tips where smplx has them."""
    joints = frame.joints_cam.copy()
    joints[:, [finger[-1] for finger in FINGER_JOINTS]] = frame.vertices_cam[:, list(SMPLX_TIPS)]
    return with_joints(frame, joints)


def moved_fingers(frame: PlantedFrame, seed: int, sigma_m: float = 0.001) -> PlantedFrame:
    """Return the frame with all joints but the wrist moved in the world, as where people marked them."""
    offsets = sigma_m * np.random.default_rng((seed, 42)).standard_normal((21, 3))
    offsets[WRIST] = 0
    R = frame.T_cam_from_world[:, :3, :3]
    return with_joints(frame, frame.joints_cam + offsets @ transpose(R))
