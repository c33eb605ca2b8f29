"""The stage `crop`: the square pictures of hands that a model is fed, cut from raw photographs."""

from collections.abc import Iterable, Iterator

import numpy as np

from poem_jax.capture.boxes_file import boxes_from_keypoints
from poem_jax.capture.frame import Frame, HandCrops
from poem_jax.capture.lens import picture_map, take_picture
from poem_jax.data.transforms import square_box
from poem_jax.geometry.cameras import crop_intrinsics
from poem_jax.geometry.distortion import undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float, UInt8

_POINTS_PER_EDGE = 9


def hand_squares(frame: Frame, rig: Rig) -> Float[Array, "hand view 4"]:
    """Return the square about each hand in each view, in pixels without distortion; NaN = unseen.

    The hand's extent is that of its key points where they say enough, else that of its box, whose outline is
    followed through the lens.
    """
    squares = np.full(frame.boxes_px.shape, np.nan)
    for hand, view in np.argwhere(np.isfinite(frame.boxes_px).all(-1)):
        points = _outline(frame.boxes_px[hand, view])
        if frame.keypoints_px is not None:
            raw = frame.keypoints_px[hand, view]
            if np.isfinite(boxes_from_keypoints(raw)).all():
                points = raw[np.isfinite(raw).all(-1)]
        squares[hand, view] = square_box(undistort_pixels(points, rig.K[view], rig.dist[view]), 1.0)
    return squares


def crop_hands(frames: Iterable[Frame], rig: Rig, ratio: float, crop_hw: tuple[int, int]) -> Iterator[Frame]:
    """Cut each hand out of every view that has an image and sees it; the other views are masked.

    Args:
        frames: With images, squares about the hands, and the hands there is a reason against.
        rig: The cameras.
        ratio: Side of a crop over the side of the square, as the model was trained.
        crop_hw: Size of the crops.
    """
    for frame in frames:
        assert frame.squares_px is not None
        squares = zip(frame.squares_px, frame.hands, strict=True)
        crops = (
            None if hand.reason else _crops(frame.images, rig, _widened(square, ratio), crop_hw)
            for square, hand in squares
        )
        yield frame._replace(crops=tuple(crops))


def _crops(
    images: tuple[UInt8[Array, "_ _ 3"] | None, ...],
    rig: Rig,
    boxes_px: Float[Array, "view 4"],
    crop_hw: tuple[int, int],
) -> HandCrops:
    views = np.zeros((len(images), *crop_hw, 3), np.uint8)
    K = np.tile(np.eye(3, dtype=np.float32), (len(images), 1, 1))
    T_cam_from_world = np.tile(np.eye(4, dtype=np.float32), (len(images), 1, 1))
    mask = np.isfinite(boxes_px).all(-1) & [image is not None for image in images]
    for view in np.flatnonzero(mask):
        views[view], K[view] = crop_image(images[view], rig, int(view), boxes_px[view], crop_hw)
        T_cam_from_world[view] = rig.T_cam_from_world[view]
    return HandCrops(views, K, T_cam_from_world, mask)


def crop_image(
    image: UInt8[Array, "h w 3"], rig: Rig, view: int, box_px: Float[Array, "4"], crop_hw: tuple[int, int]
) -> tuple[UInt8[Array, "crop_h crop_w 3"], Float[Array, "3 3"]]:
    """Sample a box (pixels without distortion) of a raw photograph; what lies beyond the photograph is black.

    Returns: the picture, and its intrinsics; it has no distortion.
    """
    K, dist = rig.K[view], rig.dist[view]
    K_crop = crop_intrinsics(K, box_px, crop_hw)
    step = float(max((box_px[2] - box_px[0]) / crop_hw[1], (box_px[3] - box_px[1]) / crop_hw[0]))
    return take_picture(image, picture_map(K, dist, K_crop, crop_hw, step)), K_crop


def _widened(squares_px: Float[Array, "view 4"], ratio: float) -> Float[Array, "view 4"]:
    corners = squares_px.reshape(-1, 2, 2)
    centre = corners.mean(1, keepdims=True)
    return (centre + ratio * (corners - centre)).reshape(-1, 4)


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
