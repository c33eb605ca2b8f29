"""The stage `crop`: the square pictures of hands that a model is fed, cut from raw photographs."""

from collections.abc import Iterable, Iterator

import numpy as np

from poem_jax.capture.boxes_file import boxes_from_keypoints
from poem_jax.capture.frame import Frame, HandCrops
from poem_jax.data.lens import ideal_pixels, picture_map, take_picture
from poem_jax.data.transforms import square_box
from poem_jax.geometry.cameras import crop_intrinsics, normalised_from_pixels, roll
from poem_jax.geometry.distortion import undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import rotation_about_z
from poem_jax.hand.topology import ROOT_JOINT, WRIST
from poem_jax.models.config import CropConfig
from poem_jax.typing import Array, Float, UInt8

_POINTS_PER_EDGE = 9


def hand_squares(frame: Frame, rig: Rig) -> Float[Array, "hand view 4"]:
    """Return the square about each hand in each view, in pixels without distortion; NaN = unseen.

    The hand's extent is that of its key points where they say enough, else that of its box, whose outline is
    followed through the lens. Where the lens has no ray for half of it, no flat picture shows the hand, and
    it counts as unseen.
    """
    squares = np.full(frame.boxes_px.shape, np.nan)
    for hand, view in np.argwhere(np.isfinite(frame.boxes_px).all(-1)):
        points = _extent(frame, rig, int(hand), int(view))
        squares[hand, view] = np.nan if points is None else square_box(points, 1.0)
    return squares


def crop_hands(
    frames: Iterable[Frame], rig: Rig, crop: CropConfig, crop_hw: tuple[int, int]
) -> Iterator[Frame]:
    """Cut each hand out of every view that has an image and sees it; the other views are masked.

    Args:
        frames: With images, squares about the hands, and the hands there is a reason against.
        rig: The cameras.
        crop: The crops that the model was trained on. Upright ones are those of cameras rolled about their
            axes until the knuckle of the middle finger is above the wrist; a view that does not see both is
            masked.
        crop_hw: Size of the crops.

    Raises:
        ValueError: Upright crops, and the capture has boxes only.
    """
    for frame in frames:
        assert frame.squares_px is not None
        crops = []
        for index, hand in enumerate(frame.hands):
            squares, turns = frame.squares_px[index], np.zeros(rig.num_views)
            if crop.upright:
                squares, turns = _upright_squares(frame, rig, index)
            boxes = _widened(squares, crop.ratio)
            crops.append(None if hand.reason else _crops(frame.images, rig, boxes, turns, crop_hw))
        yield frame._replace(crops=tuple(crops))


def _extent(frame: Frame, rig: Rig, hand: int, view: int) -> Float[Array, "point 2"] | None:
    """Return points about a hand in a view, in pixels without distortion; None = most have none."""
    points = _outline(frame.boxes_px[hand, view])
    if frame.keypoints_px is not None:
        raw = frame.keypoints_px[hand, view]
        if np.isfinite(boxes_from_keypoints(raw)).all():
            points = raw[np.isfinite(raw).all(-1)]
    ideal = ideal_pixels(points, rig.K[view], rig.dist[view])
    shown = np.isfinite(ideal).all(-1)
    return ideal[shown] if 2 * shown.sum() > len(shown) else None


def _upright_squares(
    frame: Frame, rig: Rig, hand: int
) -> tuple[Float[Array, "view 4"], Float[Array, "view"]]:
    """Return the squares about a hand in images turned until it stands upright, and the turns, radians."""
    if frame.keypoints_px is None:
        raise ValueError(
            "the model was trained on upright hands, which 2D key points tell; this capture has boxes only: "
            "give `keypoints_px`, or let `poem reconstruct` find them in the images"
        )
    squares, turns = np.full((rig.num_views, 4), np.nan), np.zeros(rig.num_views)
    ends = frame.keypoints_px[hand][:, [WRIST, ROOT_JOINT]]
    for view in np.flatnonzero(np.isfinite(ends).all((-2, -1)) & np.isfinite(frame.boxes_px[hand]).all(-1)):
        K = rig.K[view]
        wrist, knuckle = normalised_from_pixels(K, undistort_pixels(ends[view], K, rig.dist[view]))
        up = knuckle - wrist
        turns[view] = -np.pi / 2 - np.arctan2(up[1], up[0])
        _, H = roll(K, rig.T_cam_from_world[view], turns[view])
        points = _extent(frame, rig, hand, int(view))
        if points is None:
            continue
        turned = np.concatenate([points, np.ones_like(points[:, :1])], -1) @ H.T
        squares[view] = square_box(turned[:, :2] / turned[:, 2:], 1.0)
    return squares, turns


def _crops(
    images: tuple[UInt8[Array, "_ _ 3"] | None, ...],
    rig: Rig,
    boxes_px: Float[Array, "view 4"],
    turns: Float[Array, "view"],
    crop_hw: tuple[int, int],
) -> HandCrops:
    views = np.zeros((len(images), *crop_hw, 3), np.uint8)
    K = np.tile(np.eye(3, dtype=np.float32), (len(images), 1, 1))
    T_cam_from_world = np.tile(np.eye(4, dtype=np.float32), (len(images), 1, 1))
    mask = np.isfinite(boxes_px).all(-1) & [image is not None for image in images]
    for view in np.flatnonzero(mask):
        turn = float(turns[view])
        views[view], K[view] = crop_image(images[view], rig, int(view), boxes_px[view], crop_hw, turn)
        T_cam_from_world[view], _ = roll(rig.K[view], rig.T_cam_from_world[view], turn)
    return HandCrops(views, K, T_cam_from_world, mask)


def crop_image(
    image: UInt8[Array, "h w 3"],
    rig: Rig,
    view: int,
    box_px: Float[Array, "4"],
    crop_hw: tuple[int, int],
    turn: float = 0.0,
) -> tuple[UInt8[Array, "crop_h crop_w 3"], Float[Array, "3 3"]]:
    """Sample a box (pixels without distortion) of a raw photograph; what lies beyond the photograph is black.

    Args:
        image: The photograph.
        rig: The cameras.
        view: Which of them took it.
        box_px: In the image of the camera rolled by `turn` (`geometry.cameras.roll`).
        crop_hw: Size of the picture.
        turn: Radians, clockwise as the image is turned.

    Returns: the picture, and its intrinsics; it has no distortion.
    """
    K, dist = rig.K[view], rig.dist[view]
    K_crop = crop_intrinsics(K, box_px, crop_hw)
    step = float(max((box_px[2] - box_px[0]) / crop_hw[1], (box_px[3] - box_px[1]) / crop_hw[0]))
    R_cam_from_rolled = rotation_about_z(-turn) if turn else None
    return take_picture(image, picture_map(K, dist, K_crop, crop_hw, step, R_cam_from_rolled)), K_crop


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
