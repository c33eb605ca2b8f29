"""Labels as the released tars have them, written from their description alone, not by our own packer."""

import pickle

import numpy as np

from poem_jax.data.frames import MultiViewFrame
from tests.data.tars import write_tar

JPEG = b"\xff\xd8 a picture \xff\xd9"


def released_label(frame: MultiViewFrame, *, world_to_camera: bool, mean=None) -> dict:
    """The label of a frame: index pixels, 4x4 extrinsics, boxes of twice the hand's side, flattened pose."""
    index_px = frame.keypoints_px - 0.5
    low, high = index_px.min(1), index_px.max(1)
    K = frame.K.copy()
    K[:, 0, 2] -= 0.5
    K[:, 1, 2] -= 0.5
    T = frame.T_cam_from_world if world_to_camera else np.linalg.inv(frame.T_cam_from_world)
    pose = frame.pose_cam.reshape(-1, 48).copy()
    if mean is not None:
        pose[:, 3:] -= mean
    views = len(frame.images)
    return {
        "cam_extr": [T[i].astype(np.float32) for i in range(views)],
        "cam_intr": [K[i] for i in range(views)],
        "cam_serial": list(frame.view_names),
        "raw_size": [np.array(size) for size in frame.size_wh],
        "joints_3d": list(frame.joints_cam.astype(np.float32)),
        "verts_3d": list(frame.vertices_cam.astype(np.float32)),
        "joints_2d": list(index_px.astype(np.float32)),
        "joints_vis": [np.ones(21, np.float32)] * views,
        "bbox_center": [np.array([int(c[0]), int(c[1])]) for c in (low + high) / 2],
        "bbox_scale": [2.0 * side for side in (high - low).max(-1)],
        "image_path": [f"{name}.jpg" for name in frame.view_names],
        "mano_pose": list(pose.astype(np.float32)),
        "mano_shape": list(frame.shape.astype(np.float32)),
        "sample_idx": list(range(views)),
    }


def tar_sample(key, label, views, ending="jpg"):
    images = {f"image_{i}.{ending}": JPEG + bytes([i]) for i in range(views)}
    return key, {**images, "label.pyd": label if isinstance(label, bytes) else pickle.dumps(label)}


def write_label(path, label, views=3):
    """One shard with one sample."""
    return write_tar(path, [tar_sample("000001", label, views)])
