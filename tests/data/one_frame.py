"""A frame of one hand before real cameras: unequal focal lengths, a skew, off-centre axes."""

import numpy as np

from poem_jax.data.frames import EncodedImage, MultiViewFrame
from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    matmul,
    rotation_from_axis_angle,
    transform_points,
)
from poem_jax.hand.model import hand_mesh, mirror
from poem_jax.hand.template import default_hand
from tests.rigs import look_at

SIZE_WH = (320, 240)


def one_frame(seed=0, views=3, side="right", skew=0.4, key="take/000001", dtype=np.float64) -> MultiViewFrame:
    """A posed hand in the middle of cameras that look at it, with its pose in each camera's frame."""
    rng = np.random.default_rng(seed)
    hand = default_hand("right")
    hand = mirror(hand) if side == "left" else hand
    shape = rng.normal(size=10)
    pose = 0.25 * rng.normal(size=(16, 3))
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    places = np.stack([0.7 * np.cos(angles), 0.6 * np.sin(angles), 0.2 + 0.1 * angles], -1)
    T = np.stack([look_at(place, np.array([0.01, -0.02, 0.0]), 0.3 * i) for i, place in enumerate(places)])
    K = np.array([[[300.0 + i, skew, 151 - i], [0, 310 - 2 * i, 126 + i], [0, 0, 1]] for i in range(views)])
    # Each camera's own pose of the wrist; the mesh is placed by its wrist joint.
    world = hand_mesh(hand, pose, shape, center_joint=0)
    wrist = rotation_from_axis_angle(pose[0])
    poses = np.repeat(pose[None], views, 0)
    poses[:, 0] = axis_angle_from_rotation(matmul(T[:, :3, :3], wrist))
    joints = transform_points(T, world.joints[None])
    frame = MultiViewFrame(
        key=key,
        images=tuple(EncodedImage(b"\xff\xd8", f"{key} {i}") for i in range(views)),
        view_names=tuple(f"cam{i}" for i in range(views)),
        size_wh=np.tile(SIZE_WH, (views, 1)),
        K=K,
        T_cam_from_world=T,
        joints_cam=joints,
        vertices_cam=transform_points(T, world.vertices[None]),
        keypoints_px=project_cam(K, joints),
        pose_cam=poses,
        shape=np.repeat(shape[None], views, 0),
    )
    return frame._replace(
        **{
            name: getattr(frame, name).astype(dtype)
            for name in ("K", "T_cam_from_world", "joints_cam", "vertices_cam", "keypoints_px", "pose_cam")
        }
    )
