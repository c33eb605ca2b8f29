"""From a frame to what a model is fed: a crop of every hand from every view, left hands as right ones.

The models know right hands. A left hand is reconstructed in the world mirrored by D = diag(-1, 1, 1):
extrinsics D T D, images flipped, principal points W - cx; what comes back is mirrored again. Re-anchored to
the primary camera this is the mirroring in that camera's Y-Z plane.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from poem_jax.batch import Prediction
from poem_jax.capture.boxes_file import HandBoxes
from poem_jax.capture.crops import crop_box, crop_hand
from poem_jax.geometry.cameras import mirror_intrinsics, mirror_pixels, mirror_points, mirror_world
from poem_jax.geometry.rig import Rig
from poem_jax.hand.model import mirror_pose
from poem_jax.typing import Array, Bool, Float, UInt8


class HandSample(NamedTuple):
    """One hand of one frame, as a model is fed; masked views hold zeros and identity matrices."""

    views: UInt8[Array, "view h w 3"]
    K: Float[Array, "view 3 3"]
    T_cam_from_world: Float[Array, "view 4 4"]
    view_mask: Bool[Array, " view"]


class HandResult(NamedTuple):
    """One hand of one frame, reconstructed, in the capture's world."""

    valid: bool
    vertices_world: Float[Array, "778 3"]
    joints_world: Float[Array, "21 3"]
    root_world: Float[Array, "3"]
    keypoints_px: Float[Array, "view joint 2"] | None = None
    """A network's heat-map coordinates in ideal pixels of its (unflipped) crops."""
    pose: Float[Array, "16 3"] | None = None
    shape: Float[Array, "10"] | None = None
    translation: Float[Array, "3"] | None = None
    joint_sigma_m: Float[Array, "21"] | None = None
    """Standard deviation of one coordinate of each joint, where the engine knows it."""


def make_sample(
    images: Sequence[UInt8[Array, "h w 3"] | None],
    rig: Rig,
    hands: HandBoxes,
    frame: int,
    hand: int,
    out_hw: tuple[int, int],
) -> HandSample:
    """Crop one hand from every view that has an image and a box; the other views are masked."""
    sample = empty_sample(len(images), out_hw)
    for view, image in enumerate(images):
        box_px = None if image is None else crop_box(hands, frame, hand, view, rig)
        if image is None or box_px is None:
            continue
        crop = crop_hand(image, rig.K[view], rig.dist[view], box_px, out_hw)
        sample.views[view], sample.K[view], sample.view_mask[view] = crop.image, crop.K, True
        sample.T_cam_from_world[view] = rig.T_cam_from_world[view]
    return mirror_sample(sample) if hands.hand_side[hand] == "left" else sample


def empty_sample(num_views: int, out_hw: tuple[int, int]) -> HandSample:
    """Return a sample of which every view is masked."""
    return HandSample(
        np.zeros((num_views, *out_hw, 3), np.uint8),
        np.tile(np.eye(3, dtype=np.float32), (num_views, 1, 1)),
        np.tile(np.eye(4, dtype=np.float32), (num_views, 1, 1)),
        np.zeros(num_views, bool),
    )


def mirror_sample(sample: HandSample) -> HandSample:
    """Return the capture of the mirrored hand in the mirrored world; its own inverse."""
    return HandSample(
        np.ascontiguousarray(sample.views[:, :, ::-1]),
        mirror_intrinsics(sample.K, sample.views.shape[2]),
        mirror_world(sample.T_cam_from_world),
        sample.view_mask,
    )


def take_result(prediction: Prediction, index: int) -> HandResult:
    """Take one sample out of a prediction, as NumPy."""

    def optional(batched: Array | None) -> Array | None:
        return None if batched is None else np.asarray(batched[index])

    return HandResult(
        bool(prediction.valid[index]),
        np.asarray(prediction.vertices_world[index]),
        np.asarray(prediction.joints_world[index]),
        np.asarray(prediction.root_world[index]),
        np.asarray(prediction.keypoints_px[index]),
        optional(prediction.pose),
        optional(prediction.shape),
        optional(prediction.translation),
    )


def mirror_result(result: HandResult, crop_width: int) -> HandResult:
    """Bring a result of `mirror_sample` back to the world that it was mirrored from."""
    return HandResult(
        result.valid,
        mirror_points(result.vertices_world),
        mirror_points(result.joints_world),
        mirror_points(result.root_world),
        None if result.keypoints_px is None else mirror_pixels(result.keypoints_px, crop_width),
        None if result.pose is None else mirror_pose(result.pose),
        result.shape,
        None if result.translation is None else mirror_points(result.translation),
        result.joint_sigma_m,
    )
