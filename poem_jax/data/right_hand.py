"""A left hand given as the right hand that a mirror shows, in every camera.

With D = diag(-1, 1, 1) every camera's frame is reflected by itself: points D p, extrinsics D T D (so that the
mirrored cameras see one mirrored world), pixels u' = 2 cx - u. A camera with the skew negated then projects
the mirrored points exactly onto the mirrored pixels, and the pictures follow when they are decoded
(`MultiViewFrame.mirror_px`).
"""

import numpy as np

from poem_jax.data.frames import MultiViewFrame
from poem_jax.hand.model import mirror_pose
from poem_jax.typing import Array, Float

_POINT_SIGN = np.array([-1, 1, 1], np.float32)
_FRAME_SIGN = np.array([-1, 1, 1, 1], np.float32)
_K_SIGN = np.array([[1, -1, 1], [1, 1, 1], [1, 1, 1]], np.float32)


def as_right_hand(frame: MultiViewFrame) -> MultiViewFrame:
    """Return the mirrored frame of a left hand: labels, cameras, boxes, and the column to mirror at.

    Args:
        frame: labels of a left hand and `mirror_px` None, in the conventions of `MultiViewFrame`; its pose is
            that of the left hand's own model, zero = flat.

    Returns: the right hand, with `mirror_px` = cx of each view, span pixels.

    Raises: ValueError: the frame is mirrored already.
    """
    if frame.mirror_px is not None:
        raise ValueError(f"sample {frame.key} is mirrored already: its labels are those of a right hand")
    center_px = frame.K[:, 0, 2]
    return frame._replace(
        K=frame.K * _K_SIGN,
        T_cam_from_world=mirror_rigid(frame.T_cam_from_world),
        joints_cam=frame.joints_cam * _POINT_SIGN,
        vertices_cam=frame.vertices_cam * _POINT_SIGN,
        keypoints_px=mirror_pixels(frame.keypoints_px, center_px[:, None]),
        pose_cam=None if frame.pose_cam is None else mirror_pose(frame.pose_cam),
        box_px=None if frame.box_px is None else _mirror_boxes(frame.box_px, center_px),
        mirror_px=center_px.copy(),
    )


def mirror_rigid(T_b_from_a: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """Return D T D: the transform between the frames reflected in their Y-Z planes."""
    return T_b_from_a * _FRAME_SIGN * _FRAME_SIGN[:, None]


def mirror_pixels(
    uv_px: Float[Array, "*batch 2"], mirror_px: Float[Array, "*#batch"]
) -> Float[Array, "*batch 2"]:
    """Return u' = 2 mirror_px - u, v' = v."""
    return np.stack([2 * mirror_px - uv_px[..., 0], uv_px[..., 1]], axis=-1)


def _mirror_boxes(box_px: Float[Array, "view 4"], mirror_px: Float[Array, " view"]) -> Float[Array, "view 4"]:
    x0, y0, x1, y1 = box_px.T
    return np.stack([2 * mirror_px - x1, y0, 2 * mirror_px - x0, y1], axis=-1)
