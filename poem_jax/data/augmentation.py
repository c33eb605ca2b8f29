"""From a frame and chosen views to a training sample: crops, their cameras and the truth, all moved together.

The world is the camera of the first chosen view as it was before any turn, and the truth is what is stored
for that view. A turn by `a` about a camera's optical axis makes its extrinsic Rot(a) T and leaves the hand in
place (paper, section "Data Augmentation", and both releases); where the recipe turns the first view too
(POEM v1), that one's extrinsic is Rot(a), not the identity.

A left hand's mirror (`MultiViewFrame.mirror_px`) is part of the one warp that makes a crop. The release of
POEM v2 mirrors the whole image first, which interpolates twice and loses what the mirror moves out of it.
Its visibility of key points is left out: no model here reads it.
"""

import math

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.augmentation_recipes import (
    NONE,
    PAPER,
    RELEASE_V1,
    RELEASE_V2,
    CropFormulas,
    Draws,
    Recipe,
    draw,
)
from poem_jax.data.crops import Crops, Squares, exact_crops, exact_squares, release_crops, release_squares
from poem_jax.data.frames import CorruptSampleError, MultiViewFrame
from poem_jax.data.lens import stored_picture_map, take_picture
from poem_jax.data.pictures import (
    EIGHTHS,
    Decoder,
    Picture,
    apply_gains,
    decode_shrunk,
    eighths_for,
    warp,
)
from poem_jax.geometry.cameras import Cameras, anchor_to_primary, transform_pixels
from poem_jax.geometry.rig import HALF_PIXEL
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.typing import Array, Float, Int, UInt8

__all__ = ["NONE", "PAPER", "RELEASE_V1", "RELEASE_V2", "Draws", "Recipe", "augment", "draw", "transform"]


def augment(
    frame: MultiViewFrame,
    views: Int[Array, " chosen"],
    recipe: Recipe,
    image_hw: tuple[int, int],
    rng: np.random.Generator,
    using: Decoder | None = None,
) -> MultiViewBatch:
    """Make a sample of the chosen views; a pure function of its arguments and the generator's state.

    Args:
        views: indices of the frame's views, the first is the primary one.
        image_hw: height and width of the crops.
        using: decoder; None = OpenCV.

    Returns: what `transform` returns.

    Raises: CorruptSampleError: an image of the chosen views cannot be used.
    """
    return transform(frame, views, draw(recipe, len(views), rng), recipe, image_hw, using)


def transform(
    frame: MultiViewFrame,
    views: Int[Array, " chosen"],
    draws: Draws,
    recipe: Recipe,
    image_hw: tuple[int, int],
    using: Decoder | None = None,
) -> MultiViewBatch:
    """Make the sample that given draws decide; arguments and errors as for `augment`.

    Returns: a `MultiViewBatch` without batch axis: crops in uint8, all else in float32; `keypoints_px` are
        the stored ones, moved with the pixels; `cameras` map from the first view's un-turned frame.
    """
    views = np.asarray(views)
    squares = _squares(frame, views, recipe).moved(draws.shift, draws.scale)
    make = exact_crops if recipe.formulas is CropFormulas.EXACT else release_crops
    crops = make(frame.K[views].astype(np.float64), squares, draws.angle, image_hw)
    images = [
        _crop_image(frame, view, row, squares, crops, draws, recipe, image_hw, using)
        for row, view in enumerate(views.tolist())
    ]
    pose, shape = frame.pose_cam, frame.shape
    return MultiViewBatch(
        views=np.stack(images),
        cameras=Cameras(crops.K.astype(np.float32), _extrinsics(frame, views, crops, draws)),
        joints_world=frame.joints_cam[views[0]].astype(np.float32),
        vertices_world=frame.vertices_cam[views[0]].astype(np.float32),
        keypoints_px=transform_pixels(
            crops.H_crop_from_image, frame.keypoints_px[views].astype(np.float64)
        ).astype(np.float32),
        pose=None if pose is None else pose[views[0]].astype(np.float32),
        shape=None if shape is None else shape[views[0]].astype(np.float32),
    )


def _squares(frame: MultiViewFrame, views: Int[Array, " chosen"], recipe: Recipe) -> Squares:
    """Put squares around the data set's boxes, or the key points where it has none."""
    points = frame.keypoints_px if frame.box_px is None else frame.box_px.reshape(-1, 2, 2)
    around = exact_squares if recipe.formulas is CropFormulas.EXACT else release_squares
    return around(points[views].astype(np.float64), recipe.box_ratio)


def _extrinsics(
    frame: MultiViewFrame, views: Int[Array, " chosen"], crops: Crops, draws: Draws
) -> Float[Array, "chosen 4 4"]:
    """Return T_turned_from_first, with errors of calibration between the camera and its turn."""
    T_cam_from_world = frame.T_cam_from_world[views].astype(np.float64)
    T_cam_from_first, _ = anchor_to_primary(T_cam_from_world, np.ones(len(views), bool))
    error = draws.calibration_error
    T_wrong_from_cam = rigid(rotation_from_axis_angle(error[:, :3]), error[:, 3:])
    return (crops.T_turned_from_cam @ T_wrong_from_cam @ T_cam_from_first).astype(np.float32)


def _crop_image(
    frame: MultiViewFrame,
    view: int,
    row: int,
    squares: Squares,
    crops: Crops,
    draws: Draws,
    recipe: Recipe,
    image_hw: tuple[int, int],
    using: Decoder | None,
) -> UInt8[Array, "h w 3"]:
    """Decode view `view` of the frame, the sample's number `row`, and make its crop."""
    image = frame.images[view]
    mirror_px = None if frame.mirror_px is None else float(frame.mirror_px[view])
    dist = None if frame.dist is None else frame.dist[view]
    shrinks = recipe.shrinks_while_decoding and not draws.occluded[row] and dist is None
    scale = image_hw[1] / squares.side_px[row]
    try:
        picture = decode_shrunk(image, frame.size_wh[view], eighths_for(scale) if shrinks else EIGHTHS, using)
    except ValueError as error:
        raise CorruptSampleError(image.name, frame.key, str(error)) from error
    if draws.occluded[row]:
        box = _patch_box(squares, draws, row)
        picture = _occlude(picture, box, mirror_px, np.random.default_rng(draws.noise_seed[row]))
    H_crop_from_image = crops.H_crop_from_image[row]
    if dist is None:
        crop = warp(picture, H_crop_from_image, image_hw, mirror_px)
    else:
        K = frame.K[view].astype(np.float64)
        where = stored_picture_map(K, dist, mirror_px, H_crop_from_image @ K, image_hw, 1.0)
        crop = take_picture(picture.rgb, where)
    return apply_gains(crop, draws.gains[row]) if (draws.gains[row] != 1).any() else crop


def _patch_box(squares: Squares, draws: Draws, row: int) -> Float[Array, "4"]:
    """Return left, top, width and height of the patch, pixels counted from the top-left pixel's centre."""
    side, (area, shape, across, down) = squares.side_px[row], draws.patch[row]
    width, height = side * math.sqrt(area / shape), side * math.sqrt(area * shape)
    start = squares.center_px[row] - HALF_PIXEL - side / 2
    return np.array([*(start + [across, down] * (side - [width, height] - 1)), width, height])


def _occlude(
    picture: Picture, box: Float[Array, "4"], mirror_px: float | None, rng: np.random.Generator
) -> Picture:
    """Put noise where the patch lies wholly inside the image; the picture is changed."""
    height, width = picture.rgb.shape[:2]
    if mirror_px is not None:
        # Columns are counted by their left edges, so that the mirror of the right edge is the new left one.
        box = np.array([2 * mirror_px - box[0] - box[2], *box[1:]])
    if (box[:2] < 0).any() or (box[:2] + box[2:] >= [width, height]).any():
        return picture
    left, top, columns, rows = box.astype(int)
    noise = rng.integers(0, 256, (rows, columns, 3), np.uint8)
    picture.rgb[top : top + rows, left : left + columns] = noise
    return picture
