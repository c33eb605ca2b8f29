"""Whether the boxes and the rig of a take agree: judged once, before any image is read.

A wrong rig spoils every hand of every frame; a wrong box spoils one hand of one frame. So all hands are
looked at together. The views of a hand *meet* if some point within reach projects into its boxes in all of
them: into the squares about the boxes, before these are widened for the crops. Where most hands' views do not
meet, the take is refused; where a few do not, these hands are left out, with the reason.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from poem_jax.calibration.lens_reach import beyond_the_lens
from poem_jax.capture.crop import hand_squares
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.take import in_groups
from poem_jax.geometry.camera_checks import INVERTED, check_cameras, check_distances, views_meet
from poem_jax.geometry.cameras import Cameras, crop_intrinsics
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.typing import Array, Bool, Float

_SQUARE_HW = (1, 1)
_WINDOW = 256
"""Frames that are judged together; their images are not read yet."""
_SUSPICIOUS_SHARE = 0.25
_CERTAIN_SHARE = 0.9
_CHUNK = 256
_WHAT_TO_CHECK = (
    "check that K belongs to the images as they are, that x_cam = R @ x_world + t in the unit given, and "
    "that the boxes are in the rig's order of cameras"
)


def judge_boxes(frames: Iterable[Frame], rig: Rig) -> Iterator[Frame]:
    """Find the square about each hand, and mark the hands whose boxes do not fit together.

    Args:
        frames: A stream, without images so far.
        rig: The cameras.

    Returns: the stream, with `squares_px`, and `hands` that hold a reason where there is one; and a warning
        at the first frame of which a lens does not show what its boxes hold.

    Raises:
        ValueError: A camera is wrong by itself, the cameras are too far apart, or most hands' views do not
            meet in the first frames. The message says what, expected, got and fix.
    """
    check_each_camera(rig)
    said = False
    for index, group in enumerate(in_groups(frames, _WINDOW)):
        squares = np.stack([hand_squares(frame, rig) for frame in group])
        reasons = iter(_reasons_against(squares.reshape(-1, rig.num_views, 4), rig, refuse=index == 0))
        unused = np.zeros(rig.num_views, bool)
        for frame, squares_px in zip(group, squares, strict=True):
            hands = tuple(HandResult(unused, next(reasons)) for _ in squares_px)
            lost = np.isfinite(frame.boxes_px).all(-1) & ~np.isfinite(squares_px).all(-1)
            warnings = [] if said else beyond_the_lens(rig, lost.sum(0), "hands")
            said = said or bool(warnings)
            yield frame._replace(squares_px=squares_px, hands=hands, warnings=(*frame.warnings, *warnings))


def _reasons_against(
    squares_px: Float[Array, "sample view 4"], rig: Rig, *, refuse: bool
) -> list[str | None]:
    """Return why a hand cannot be reconstructed, for every sample; None where nothing is known against it."""
    cams = _square_cameras(squares_px, rig)
    check_distances(cams)
    several = cams.view_mask.sum(-1) > 1
    lost = several & ~_meet(cams)
    without = _met_without(cams, lost)
    if refuse and lost.sum() > _SUSPICIOUS_SHARE * several.sum():
        _check_direction(cams, several & ~lost)
    if refuse and 2 * lost.sum() > several.sum():
        raise ValueError(
            f"the rig does not fit the boxes: for {lost.sum()} of {several.sum()} hands expected a point "
            "that projects into the boxes of all views, got none"
            f"{_suspects(rig, without[lost].mean(0) > 0.5)}; {_WHAT_TO_CHECK}"
        )
    return [_reason(rig, without[i]) if lost[i] else None for i in range(len(lost))]


def _square_cameras(squares_px: Float[Array, "sample view 4"], rig: Rig) -> Cameras:
    """Return cameras whose images are the squares, one pixel wide; views that see no hand are masked."""
    mask = np.isfinite(squares_px).all(-1)
    K = np.tile(np.eye(3), (*mask.shape, 1, 1))
    for sample, view in np.argwhere(mask):
        K[sample, view] = crop_intrinsics(rig.K[view], squares_px[sample, view], _SQUARE_HW)
    return Cameras(K, np.broadcast_to(rig.T_cam_from_world, (*mask.shape, 4, 4)), mask)


def check_each_camera(rig: Rig) -> None:
    """Raise ValueError if a camera is wrong by itself, and say which."""
    for view, name in enumerate(rig.names):
        width, height = (int(size) for size in rig.size_wh[view])
        try:
            check_cameras(Cameras(rig.K[[view]], rig.T_cam_from_world[[view]]), (height, width))
        except ValueError as error:
            raise ValueError(f"camera '{name}' of the rig: {error}") from error


def _check_direction(cams: Cameras, met: Bool[Array, " sample"]) -> None:
    inverse = cams._replace(T_cam_from_world=invert_rigid(cams.T_cam_from_world))
    several = cams.view_mask.sum(-1) > 1
    meets = (several & _meet(inverse)).sum()
    if meets > max(met.sum(), _CERTAIN_SHARE * several.sum()):
        raise ValueError(INVERTED)


def _met_without(cams: Cameras, lost: Bool[Array, " sample"]) -> Bool[Array, "sample view"]:
    """Tell which views of the lost hands stand alone: without them the others, two at least, meet."""
    found = np.zeros(cams.view_mask.shape, bool)
    for view in range(cams.view_mask.shape[-1]):
        others = cams.view_mask[lost] & (np.arange(cams.view_mask.shape[-1]) != view)
        rest = Cameras(cams.K[lost], cams.T_cam_from_world[lost], others)
        found[lost, view] = cams.view_mask[lost, view] & (others.sum(-1) > 1) & _meet(rest)
    return found


def _meet(cams: Cameras) -> Bool[Array, " sample"]:
    starts = range(0, len(cams.K), _CHUNK)
    parts = [Cameras(*(array[start : start + _CHUNK] for array in cams)) for start in starts]
    return np.concatenate([views_meet(part, _SQUARE_HW, 0.0) for part in parts] or [np.zeros(0, bool)])


def _reason(rig: Rig, without: Bool[Array, " view"]) -> str:
    return f"no point projects into the boxes of all views{_suspects(rig, without)}: box or calibration?"


def _suspects(rig: Rig, views: Sequence[bool] | Array) -> str:
    names = [repr(name) for name, suspected in zip(rig.names, views, strict=True) if suspected]
    return f"; without camera {' or '.join(names)} there is one" if names else ""
