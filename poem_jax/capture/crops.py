"""The square pictures of hands that a model is fed, cut from raw photographs."""

from typing import NamedTuple

import numpy as np

from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints
from poem_jax.capture.lens import picture_map, take_picture
from poem_jax.data.transforms import square_box
from poem_jax.geometry.cameras import Cameras, crop_intrinsics
from poem_jax.geometry.distortion import undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.synthetic.config import CropConfig
from poem_jax.typing import Array, Float, UInt8

EXPAND_RATIO = CropConfig().expand_ratio
"""Side of a crop over the longer side of the box of the joints: as the model was trained."""
_POINTS_PER_EDGE = 9


class Crop(NamedTuple):
    """A square picture of a hand."""

    image: UInt8[Array, "h w 3"]
    K: Float[Array, "3 3"]
    """Intrinsics of the picture: it has no distortion."""


def crop_box(hands: HandBoxes, frame: int, hand: int, view: int, rig: Rig) -> Float[Array, "4"] | None:
    """Return the square box of a crop in ideal pixels, or None where the view does not see the hand.

    The hand's extent is that of its key points where they say enough, else that of its box, whose outline is
    followed through the lens.
    """
    box = hands.boxes_px[frame, hand, view]
    if not np.isfinite(box).all():
        return None
    points = _outline(box)
    if hands.keypoints_px is not None:
        raw = hands.keypoints_px[frame, hand, view]
        if np.isfinite(boxes_from_keypoints(raw)).all():
            points = raw[np.isfinite(raw).all(-1)]
    return square_box(undistort_pixels(points, rig.K[view], rig.dist[view]), EXPAND_RATIO)


def crop_cameras(hands: HandBoxes, rig: Rig, out_hw: tuple[int, int]) -> Cameras:
    """Return the cameras (frame * hand, view) of all crops of a take; views that see no hand are masked."""
    frames, num_hands = hands.boxes_px.shape[:2]
    K = np.tile(np.eye(3), (frames, num_hands, rig.num_views, 1, 1))
    mask = np.zeros((frames, num_hands, rig.num_views), bool)
    for frame, hand, view in np.ndindex(*mask.shape):
        box_px = crop_box(hands, frame, hand, view, rig)
        if box_px is not None:
            mask[frame, hand, view], K[frame, hand, view] = True, crop_intrinsics(rig.K[view], box_px, out_hw)
    T_cam_from_world = np.broadcast_to(rig.T_cam_from_world, (*mask.shape, 4, 4))
    return Cameras(*(array.reshape(-1, *array.shape[2:]) for array in (K, T_cam_from_world, mask)))


def crop_hand(
    image: UInt8[Array, "h w 3"],
    K: Float[Array, "3 3"],
    dist: Float[Array, " term"],
    box_px: Float[Array, "4"],
    out_hw: tuple[int, int],
) -> Crop:
    """Sample the box (ideal pixels) of a raw photograph; what lies beyond the photograph is black."""
    K_crop = crop_intrinsics(K, box_px, out_hw)
    step = float(max((box_px[2] - box_px[0]) / out_hw[1], (box_px[3] - box_px[1]) / out_hw[0]))
    return Crop(take_picture(image, picture_map(K, dist, K_crop, out_hw, step)), K_crop)


def _outline(box_px: Float[Array, "4"]) -> Float[Array, "point 2"]:
    """Points along the four edges of a box."""
    u, v = np.meshgrid(
        np.linspace(box_px[0], box_px[2], _POINTS_PER_EDGE),
        np.linspace(box_px[1], box_px[3], _POINTS_PER_EDGE),
    )
    points = np.stack([u, v], axis=-1)
    edge = np.ones(u.shape, bool)
    edge[1:-1, 1:-1] = False
    return points[edge]
