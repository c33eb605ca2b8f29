"""A frame whose picture shows its joints: a bright blob on each, in cameras that all differ."""

import cv2
import numpy as np

from poem_jax.data.frames import EncodedImage, MultiViewFrame
from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle, transform_points

SIZE_WH = (320, 240)


def planted_frame(views: int = 3, *, fx_over_fy: float = 1.1, skew: float = 0.0, mirrored: bool = False):
    """A frame of few, far joints, so that blobs stay apart; where `mirrored`, the stored pictures are those
    that the mirror turns into what the labels say."""
    rng = np.random.default_rng(5)
    flat = 0.04 * np.stack(np.meshgrid([-2, -1, 0, 1, 2], [-1.5, -0.5, 0.5, 1.5]), -1).reshape(-1, 2)
    joints_world = np.zeros((21, 3))
    joints_world[:20, :2] = flat + rng.uniform(-0.005, 0.005, flat.shape)
    joints_world[20] = joints_world[0]
    T_cam_from_world = rigid(
        rotation_from_axis_angle(rng.normal(0, 0.2, (views, 3))),
        rng.uniform([0, -0.09, 0.75], [0.1, 0.01, 0.85], (views, 3)),
    )
    K = np.zeros((views, 3, 3))
    K[:, 0, 0] = 300 * fx_over_fy + 10 * np.arange(views)
    K[:, 1, 1] = K[:, 0, 0] / fx_over_fy
    K[:, 0, 1] = skew
    K[:, :, 2] = [150.3, 125.2, 1]
    joints_cam = transform_points(T_cam_from_world, joints_world[None])
    keypoints_px = project_cam(K, joints_cam)
    mirror_px = K[:, 0, 2].copy() if mirrored else None
    stored = keypoints_px.copy()
    if mirrored:
        stored[..., 0] = 2 * K[:, :1, 2] - stored[..., 0]
    return MultiViewFrame(
        key="seq/7",
        images=tuple(
            EncodedImage(draw_blobs(points), f"shard.tar: {i}.png") for i, points in enumerate(stored)
        ),
        view_names=tuple("abcdefgh"[:views]),
        size_wh=np.array([SIZE_WH] * views),
        K=K,
        T_cam_from_world=T_cam_from_world,
        joints_cam=joints_cam,
        vertices_cam=np.repeat(joints_cam[:, :1], 778, 1),
        keypoints_px=keypoints_px,
        pose_cam=rng.normal(size=(views, 16, 3)),
        shape=rng.normal(size=(views, 10)),
        mirror_px=mirror_px,
    )


def draw_blobs(points: np.ndarray) -> bytes:
    """A PNG with a Gaussian blob, 1.5 pixels wide, about each point."""
    u, v = np.arange(SIZE_WH[0]) + 0.5, np.arange(SIZE_WH[1]) + 0.5
    image = np.zeros(SIZE_WH[::-1])
    for x, y in points[:20]:
        image += np.exp(-(((u - x) ** 2)[None] + ((v - y) ** 2)[:, None]) / (2 * 1.5**2))
    grey = np.repeat(np.round(200 * np.minimum(image, 1)).astype(np.uint8)[..., None], 3, -1)
    return cv2.imencode(".png", grey)[1].tobytes()


def blob_near(crop: np.ndarray, point: np.ndarray, radius: float = 9.0) -> np.ndarray:
    """The centre of brightness around a point of a crop, (u, v)."""
    v, u = np.mgrid[: crop.shape[0], : crop.shape[1]] + 0.5
    weight = crop[..., 1] * ((u - point[0]) ** 2 + (v - point[1]) ** 2 < radius**2)
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
