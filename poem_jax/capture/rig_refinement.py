"""A rig's extrinsics, and the cameras' offsets in time, mended by the hands that the cameras saw, and judged
by frames that were held out.

Scale and world are those in which most cameras stand where they stood (`calibration.refinement`).
"""

from typing import NamedTuple

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints, pair_distances_px
from poem_jax.calibration.refinement import MAX_HANDS, adjust_extrinsics
from poem_jax.calibration.time_offsets import find_offsets, shifted
from poem_jax.calibration.time_words import LATE_FRAMES
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import axis_angle_from_rotation, invert_rigid
from poem_jax.hand.topology import BONES
from poem_jax.typing import Array, Bool, Float

MIN_HANDS = 10
"""Hands in single frames that two views see, of those the rig is adjusted to and of those held out."""
MIN_POINTS = 150
"""Key points of a camera that another sees too, below which its place is not known."""
MIN_GAIN = 0.02
"""Of the held-out error: by less a rig is not better."""

_HELD_OUT = 3
"""Every third frame, or every third run of them."""
_RUN = 5
"""Frames of a run, where offsets in time are found: they need the neighbours of a frame."""
_CAP_SHARE = 0.04


class Refined(NamedTuple):
    """A rig before and after."""

    rig: Rig
    turned_rad: Float[Array, " view"]
    moved_m: Float[Array, " view"]
    """How far each camera's centre moved."""
    frames_late: Float[Array, " view"]
    """Offsets in time that were undone (`calibration.time_offsets`); zeros where none were looked for."""
    used_px: Float[Array, "2 view"]
    """Before and after: median distance of each camera's key points from the others' epipolar lines."""
    held_out_px: Float[Array, "2 view"]
    """The same of the frames that were held out."""
    held_out_mean_px: Float[Array, "2"]
    """Before and after: mean over all cameras, no point counting for more than 4 % of the diagonal."""

    @property
    def helps(self) -> bool:
        """Whether the held-out frames fit clearly better."""
        before, after = self.held_out_mean_px
        return bool(after < (1 - MIN_GAIN) * before)


def refine_rig(
    rig: Rig,
    keypoints_px: Float[Array, "frame hand view 21 2"],
    time_s: Float[Array, " frame"] | None = None,
    *,
    offsets: bool = False,
) -> Refined:
    """Adjust the extrinsics to two thirds of the frames and judge them by the others.

    Args:
        rig: The cameras; K and the lenses are kept.
        keypoints_px: In pixels of the raw images, OpenPose order; NaN = unseen.
        time_s: When the frames were taken, seconds; None = they are evenly spaced, in the order of time.
        offsets: Undo the cameras' offsets in time too, of `LATE_FRAMES` or more; they are found on the frames
            that the rig is adjusted to.

    Raises: ValueError: too few hands, or too few key points of a camera.
    """
    given_px = np.asarray(keypoints_px, np.float64)
    held_out = np.arange(len(given_px)) // (_RUN if offsets else 1) % _HELD_OUT == 1
    used_px = np.where(held_out[:, None, None, None, None], np.nan, given_px)
    _check_enough(rig, given_px, held_out)
    late = np.zeros(rig.num_views)
    new = rig
    aligned_px = given_px
    for _ in range(2 if offsets else 1):
        if offsets and (found := find_offsets(new, used_px, time_s)) is not None:
            late = np.where(np.abs(found.frames) < LATE_FRAMES, 0.0, found.frames)
            aligned_px = shifted(given_px, late, time_s)
        new = _adjusted(rig, aligned_px[~held_out])
    change = new.T_cam_from_world @ invert_rigid(rig.T_cam_from_world)
    turned = np.linalg.norm(axis_angle_from_rotation(change[:, :3, :3]), axis=-1)
    centres = [invert_rigid(r.T_cam_from_world)[:, :3, 3] for r in (rig, new)]
    # Of the same points before and after: those that have a neighbour in time.
    given_px = np.where(np.isfinite(aligned_px), given_px, np.nan)
    both = ((rig, given_px), (new, aligned_px))
    return Refined(
        new,
        turned,
        np.linalg.norm(centres[1] - centres[0], axis=-1),
        late,
        np.stack([_by_camera(r, px[~held_out])[0] for r, px in both]),
        np.stack([_by_camera(r, px[held_out])[0] for r, px in both]),
        np.array([_by_camera(r, px[held_out])[1] for r, px in both]),
    )


def _adjusted(rig: Rig, keypoints_px: Array) -> Rig:
    ideal = ideal_keypoints(rig, keypoints_px)
    frames, hands = ideal.shape[:2]
    group = np.tile(np.arange(hands), frames)
    ideal = ideal.reshape(-1, *ideal.shape[2:])
    usable = np.flatnonzero(_shared(np.isfinite(ideal).all(-1)).any((1, 2)))
    kept = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), MAX_HANDS)).astype(int))]
    return adjust_extrinsics(rig, ideal[kept], group[kept], BONES)


def _check_enough(rig: Rig, keypoints_px: Array, held_out: Bool[Array, " frame"]) -> None:
    if rig.num_views < 2:
        raise ValueError(f"a rig of one camera cannot be refined; got {rig.num_views}")
    shared = _shared(np.isfinite(keypoints_px).all(-1))
    for what, frames in (("to adjust the rig to", ~held_out), ("to be held out", held_out)):
        count = int(shared[frames].any((2, 3)).sum())
        if count < MIN_HANDS:
            raise ValueError(
                f"too little to refine a rig: expected at least {MIN_HANDS} hands {what} that two cameras "
                f"see, got {count} (a third of {len(keypoints_px)} frames is held out); give a longer "
                "take"
            )
    for name, count in zip(rig.names, shared[~held_out].sum((0, 1, 3)), strict=True):
        if count < MIN_POINTS:
            raise ValueError(
                f"too little to refine camera '{name}': expected {MIN_POINTS} key points or more that "
                f"another camera sees too, got {count}; move the hands where it sees them, or leave "
                "it out of the rig"
            )


def _shared(seen: Bool[Array, "*batch view joint"]) -> Bool[Array, "*batch view joint"]:
    return seen & (seen.sum(-2, keepdims=True) >= 2)


def _by_camera(rig: Rig, keypoints_px: Array) -> tuple[Float[Array, " view"], float]:
    """Return the median distance of each camera's pairs, and the mean of all."""
    cap_px = _CAP_SHARE * float(np.linalg.norm(rig.size_wh, axis=-1).mean())
    pairs = pair_distances_px(rig, keypoints_px, cap_px)
    a, b = np.triu_indices(rig.num_views, 1)
    own = [pairs[(a == view) | (b == view)] for view in range(rig.num_views)]
    return np.array([np.nanmedian(p) if np.isfinite(p).any() else np.nan for p in own]), float(
        np.nanmean(pairs)
    )
