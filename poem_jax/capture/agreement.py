"""Whether the boxes and the rig of a take agree: judged once, before any image is read.

A wrong rig spoils every hand of every frame; a wrong box spoils one hand of one frame. So all hands are
looked at together. The views of a hand *meet* if some point within reach projects into its boxes in all of
them: into the squares about the boxes, before these are widened for the crops. Where most hands' views do not
meet, the take is refused; where a few do not, these hands are left out, with the reason.
"""

from collections.abc import Sequence

import numpy as np

from poem_jax.capture.crops import EXPAND_RATIO, crop_cameras
from poem_jax.capture.take import Take
from poem_jax.geometry.camera_checks import INVERTED, check_cameras, check_distances, views_meet
from poem_jax.geometry.cameras import Cameras
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.typing import Array, Bool

Reasons = list[tuple[str | None, ...]]
"""Per frame, why a hand cannot be reconstructed; None where nothing is known against it."""

_MARGIN = (1 / EXPAND_RATIO - 1) / 2
"""From the edges of a crop to those of the square about the box."""
_SUSPICIOUS_SHARE = 0.25
_CERTAIN_SHARE = 0.9
_CHUNK = 256
_WHAT_TO_CHECK = (
    "check that K belongs to the images as they are, that x_cam = R @ x_world + t in the unit given, and "
    "that the boxes are in the rig's order of cameras"
)


def judge_take(take: Take, crop_hw: tuple[int, int]) -> Reasons:
    """Return which hands have boxes that do not fit together, and with which cameras.

    Args:
        take: A take; its images are not read.
        crop_hw: Size of the model's crops.

    Raises:
        ValueError: A camera is wrong by itself, the cameras are too far apart, or most hands' views do not
            meet. The message says what, expected, got and fix.
    """
    check_each_camera(take.rig)
    cams = crop_cameras(take.hands, take.rig, crop_hw)
    check_distances(cams)
    several = cams.view_mask.sum(-1) > 1
    lost = several & ~_meet(cams, crop_hw)
    without = _met_without(cams, lost, crop_hw)
    if lost.sum() > _SUSPICIOUS_SHARE * several.sum():
        _check_direction(cams, several & ~lost, crop_hw)
    if 2 * lost.sum() > several.sum():
        raise ValueError(
            f"the rig does not fit the boxes: for {lost.sum()} of {several.sum()} hands expected a point "
            "that projects into the boxes of all views, got none"
            f"{_suspects(take, without[lost].mean(0) > 0.5)}; {_WHAT_TO_CHECK}"
        )
    reasons = [_reason(take, without[i]) if lost[i] else None for i in range(len(lost))]
    num_hands = len(take.hands.hand_side)
    return [tuple(reasons[start : start + num_hands]) for start in range(0, len(reasons), num_hands)]


def check_each_camera(rig: Rig) -> None:
    """Raise ValueError if a camera is wrong by itself, and say which."""
    for view, name in enumerate(rig.names):
        width, height = (int(size) for size in rig.size_wh[view])
        try:
            check_cameras(Cameras(rig.K[[view]], rig.T_cam_from_world[[view]]), (height, width))
        except ValueError as error:
            raise ValueError(f"camera '{name}' of the rig: {error}") from error


def _check_direction(cams: Cameras, met: Bool[Array, " sample"], crop_hw: tuple[int, int]) -> None:
    inverse = cams._replace(T_cam_from_world=invert_rigid(cams.T_cam_from_world))
    several = cams.view_mask.sum(-1) > 1
    meets = (several & _meet(inverse, crop_hw)).sum()
    if meets > max(met.sum(), _CERTAIN_SHARE * several.sum()):
        raise ValueError(INVERTED)


def _met_without(
    cams: Cameras, lost: Bool[Array, " sample"], crop_hw: tuple[int, int]
) -> Bool[Array, "sample view"]:
    """Tell which views of the lost hands stand alone: without them the others, two at least, meet."""
    found = np.zeros(cams.view_mask.shape, bool)
    for view in range(cams.view_mask.shape[-1]):
        others = cams.view_mask[lost] & (np.arange(cams.view_mask.shape[-1]) != view)
        rest = Cameras(cams.K[lost], cams.T_cam_from_world[lost], others)
        found[lost, view] = cams.view_mask[lost, view] & (others.sum(-1) > 1) & _meet(rest, crop_hw)
    return found


def _meet(cams: Cameras, crop_hw: tuple[int, int]) -> Bool[Array, " sample"]:
    starts = range(0, len(cams.K), _CHUNK)
    parts = [Cameras(*(array[start : start + _CHUNK] for array in cams)) for start in starts]
    return np.concatenate([views_meet(part, crop_hw, _MARGIN) for part in parts] or [np.zeros(0, bool)])


def _reason(take: Take, without: Bool[Array, " view"]) -> str:
    return f"no point projects into the boxes of all views{_suspects(take, without)}: box or calibration?"


def _suspects(take: Take, views: Sequence[bool] | Array) -> str:
    names = [repr(name) for name, suspected in zip(take.rig.names, views, strict=True) if suspected]
    return f"; without camera {' or '.join(names)} there is one" if names else ""
