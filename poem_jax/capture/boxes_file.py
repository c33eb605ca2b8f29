"""Where the hands are: files of boxes or of 2D key points, one entry per frame, hand and view.

Letters: F frames, H hands (tracks: a hand keeps its place in every frame), V views in the rig's order. Two
kinds of npz are read:

    boxes       `boxes_px (F, H, V, 4)` x0 y0 x1 y1, NaN = unseen; `hand_side (H,)` 'left' or 'right'
    key points  `keypoints_px (F, H, V, 21, 2)` OpenPose order, NaN = unseen; `hand_side (H,)`

both in pixels of the raw (distorted) images, both with an optional `frames (F,)` of names or numbers and an
optional `cameras (V,)` of names, by which views in another order than the rig's are matched, and an optional
`time_s (F,)`, the seconds since the take began. Key points may have a `confidence (F, H, V, 21)` from 0 to 1,
NaN = unseen: those below `MIN_CONFIDENCE` count as unseen, and so do those at exactly (0, 0) or (-1, -1),
where detectors put what they do not find. Key points count pixels from the centre of the top-left one, as
detectors and calibrations do, and are moved by half a pixel here; a box gives edges, so that the whole image
is 0 0 W H. A text `detector` names what found the key points (`fitting.detector_offsets` knows some).
"""

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.capture.boxes_labels import (
    cameras_of_views,
    detector_of,
    frames_of,
    offsets_of,
    sides_of,
    times_of,
)
from poem_jax.data.capture_folder import frame_key
from poem_jax.geometry.rig import HALF_PIXEL
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.io.atomic import whole_file
from poem_jax.io.file_names import name_key
from poem_jax.io.npz_file import read_npz
from poem_jax.typing import Array, Float, Int

HOW_TO_GET_BOXES = (
    "say where the hands are: an npz with `boxes_px (F, H, V, 4)` (x0 y0 x1 y1 in the raw images, NaN = "
    "unseen) or `keypoints_px (F, H, V, 21, 2)`, and `hand_side (H,)`; pass it by --boxes or put it beside "
    "the images as boxes.npz (docs/captures.md shows how to make one)"
)
MIN_KEYPOINTS = 5
"""Fewer key points than this do not say where a hand is."""
MIN_CONFIDENCE = 0.2
"""A key point that its detector trusts less than this is dropped; zero is below it."""
MAX_CONFIDENCE = 1.5
"""Detectors whose scores run from 0 to 1 pass 1 by a little; percent and logits by far."""
NOT_FOUND = (0.0, -1.0)
"""Where detectors put what they do not find: a key point of which both coordinates are this, a box of which
all four are."""

_log = logging.getLogger(__name__)


class HandBoxes(NamedTuple):
    """The hands of a take, in pixels of the raw images, which span [0, W] x [0, H]."""

    boxes_px: Float[Array, "frame hand view 4"]
    """x0 y0 x1 y1; NaN = unseen. Of key points: the tight box of those seen."""
    hand_side: tuple[str, ...]
    """'left' or 'right' per hand."""
    frames: tuple[str, ...] | None = None
    """Frame names as the file gives them, None where it gives none."""
    keypoints_px: Float[Array, "frame hand view 21 2"] | None = None
    """OpenPose order; NaN = unseen; None where the file holds boxes alone."""
    confidence: Float[Array, "frame hand view 21"] | None = None
    """Of the key points; None where the file gives none."""
    cameras: tuple[str, ...] | None = None
    """Names of the views as the file gives them, None where it gives none."""
    detector: str | None = None
    """What found the key points, None where the file does not say."""
    time_s: Float[Array, " frame"] | None = None
    """Seconds since the take began, None where the file gives none; NaN in frames that it does not name."""
    offsets_s: Float[Array, " view"] | None = None
    """Of the cameras, under which the frames were put together; None where the file gives none; NaN of those
    that it does not name."""


def read_boxes(path: str | os.PathLike) -> HandBoxes:
    """Read a file of boxes or key points; a file that holds both gives both.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not an npz, neither array is there, shapes or sides are wrong, a box is empty, a
            confidence is not from 0 to 1, a frame's name cannot be that of a folder, a frame or a camera
            comes twice. The message names the file, what was expected and what was found.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no boxes file at {path}; {HOW_TO_GET_BOXES}")
    content = read_npz(path)
    sides = sides_of(content, path)
    keypoints = _keypoints(content, len(sides), path)
    boxes = _boxes(content, len(sides), path)
    if boxes is None and keypoints is None:
        raise ValueError(
            f"{path} must hold `boxes_px` or `keypoints_px`; found {', '.join(content) or 'nothing'}"
        )
    if boxes is None:
        assert keypoints is not None
        boxes = boxes_from_keypoints(keypoints)
    if not len(boxes):
        raise ValueError(f"{path} must hold at least one frame; got none")
    frames = frames_of(content, len(boxes), path)
    if keypoints is not None and keypoints.shape[:3] != boxes.shape[:3]:
        raise ValueError(
            f"{path}: `keypoints_px` and `boxes_px` must agree in frames, hands and views; "
            f"got {keypoints.shape[:3]} and {boxes.shape[:3]}"
        )
    confidence = content.get("confidence") if keypoints is not None else None
    cameras = cameras_of_views(content, boxes.shape[2], path)
    times = times_of(content, len(boxes), path)
    detector = detector_of(content, path)
    offsets = offsets_of(content, boxes.shape[2], path)
    return HandBoxes(boxes, sides, frames, keypoints, confidence, cameras, detector, times, offsets)


def write_boxes(path: str | os.PathLike, boxes: HandBoxes) -> Path:
    """Write boxes, key points and confidences where there are any; `read_boxes` gives them back."""
    content = {"boxes_px": boxes.boxes_px, "hand_side": np.array(boxes.hand_side)}
    if boxes.frames is not None:
        content["frames"] = np.array(boxes.frames)
    if boxes.keypoints_px is not None:
        content["keypoints_px"] = boxes.keypoints_px - HALF_PIXEL
    if boxes.confidence is not None:
        content["confidence"] = boxes.confidence
    if boxes.cameras is not None:
        content["cameras"] = np.array(boxes.cameras)
    if boxes.detector is not None:
        content["detector"] = np.array(boxes.detector)
    if boxes.time_s is not None:
        content["time_s"] = boxes.time_s
    if boxes.offsets_s is not None:
        content["offsets_s"] = boxes.offsets_s
    # A stream, since NumPy would add a suffix to a name that has none.
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **content)
    return Path(path)


def boxes_from_keypoints(keypoints_px: Float[Array, "*batch 21 2"]) -> Float[Array, "*batch 4"]:
    """Return the tight box of the key points seen; NaN where fewer than five are, or all on one line."""
    seen = np.isfinite(keypoints_px).all(-1, keepdims=True)
    low = np.where(seen, keypoints_px, np.inf).min(-2)
    high = np.where(seen, keypoints_px, -np.inf).max(-2)
    enough = (seen.sum(-2) >= MIN_KEYPOINTS) & (high > low).all(-1, keepdims=True)
    return np.where(enough, np.concatenate([low, high], axis=-1), np.nan)


def without_boxes_outside(boxes: HandBoxes, size_wh: Int[Array, "view 2"]) -> HandBoxes:
    """Return the hands with those boxes unseen that lie wholly outside their image; a warning counts them."""
    low, high = boxes.boxes_px[..., :2], boxes.boxes_px[..., 2:]
    outside = (high <= 0).any(-1) | (low >= size_wh).any(-1)
    if outside.any():
        frame, hand, view = (int(i) for i in np.argwhere(outside)[0])
        name = frame if boxes.frames is None else boxes.frames[frame]
        _log.warning(
            "%d boxes lie wholly outside their images and count as unseen; the first: frame %s, hand %d, "
            "view %d: %s",
            *(outside.sum(), name, hand, view, boxes.boxes_px[frame, hand, view].round(1).tolist()),
        )
    seen = ~outside[..., None]
    keypoints = boxes.keypoints_px
    if keypoints is not None:
        keypoints = np.where(seen[..., None], keypoints, np.nan)
    return boxes._replace(boxes_px=np.where(seen, boxes.boxes_px, np.nan), keypoints_px=keypoints)


def align_boxes(
    boxes: HandBoxes, frames: Sequence[str], cameras: Sequence[str], path: str | os.PathLike
) -> HandBoxes:
    """Return the entries of a capture's frames and cameras, in the capture's order.

    Views are matched by name where the file names them; a camera that it does not name sees no hand. A file
    that does not must have as many views as the rig, in the rig's order. Likewise the frames, which are also
    matched by number ('9' is '0009'); where both have but one these belong together. A frame of the capture
    that the file does not name gets no hand.

    Raises:
        ValueError: The number of views or frames does not fit, a camera of the file is not in the rig, or no
            frame of the capture is in the file.
    """
    return _align_frames(_align_views(boxes, cameras, path), tuple(frames), path)


def _align_views(boxes: HandBoxes, cameras: Sequence[str], path: str | os.PathLike) -> HandBoxes:
    if boxes.cameras is None:
        if boxes.boxes_px.shape[2] != len(cameras):
            raise ValueError(
                f"{path}: the rig has {len(cameras)} views; the boxes have {boxes.boxes_px.shape[2]}; add "
                "`cameras (V,)` with the cameras' names to the file to say which is which"
            )
        return boxes._replace(cameras=tuple(cameras))
    row = {name_key(name): i for i, name in enumerate(boxes.cameras)}
    unknown = row.keys() - set(map(name_key, cameras))
    if unknown:
        raise ValueError(
            f"{path}: its `cameras` must be among the rig's ({', '.join(cameras)}); "
            f"got {', '.join(sorted(unknown))}"
        )
    columns = np.array([row.get(name_key(name), -1) for name in cameras])
    return _take_everywhere(boxes._replace(cameras=tuple(cameras)), columns, axis=2)


def _align_frames(boxes: HandBoxes, names: tuple[str, ...], path: str | os.PathLike) -> HandBoxes:
    if boxes.frames is None or len(names) == len(boxes.frames) == 1:
        if len(boxes.boxes_px) != len(names):
            raise ValueError(
                f"{path}: the capture has {len(names)} frames, the boxes {len(boxes.boxes_px)}; "
                "add `frames (F,)` with the frames' names to the file to say which is which"
            )
        return boxes._replace(frames=names)
    row = {frame_key(name): i for i, name in enumerate(boxes.frames)}
    rows = np.array([row.get(frame_key(name), -1) for name in names])
    if (rows < 0).all():
        raise ValueError(
            f"{path}: no frame of the capture ({names[0]}, ...) is among its `frames` {boxes.frames[:4]}"
        )
    return _take_everywhere(boxes._replace(frames=names), rows, axis=0)


def _take_everywhere(boxes: HandBoxes, rows: Array, axis: int) -> HandBoxes:
    """Take entries of every array along an axis; NaN where the index is -1."""
    boxes_px, keypoints_px, confidence = (
        None if array is None else _take(array, rows, axis)
        for array in (boxes.boxes_px, boxes.keypoints_px, boxes.confidence)
    )
    boxes = boxes._replace(boxes_px=boxes_px, keypoints_px=keypoints_px, confidence=confidence)
    if axis == 0 and boxes.time_s is not None:
        return boxes._replace(time_s=_take(boxes.time_s, rows, 0))
    if axis == 2 and boxes.offsets_s is not None:
        return boxes._replace(offsets_s=_take(boxes.offsets_s, rows, 0))
    return boxes


def _take(array: Array, rows: Array, axis: int) -> Array:
    found = np.expand_dims(rows >= 0, tuple(i for i in range(array.ndim) if i != axis))
    return np.where(found, array.take(rows, axis), np.nan)


def _keypoints(content: Mapping[str, Array], num_hands: int, path: Path) -> Array | None:
    if "keypoints_px" not in content:
        return None
    keypoints = _checked(content, "keypoints_px", (num_hands, NUM_JOINTS, 2), path)
    keypoints = np.where(np.isfinite(keypoints).all(-1, keepdims=True), keypoints, np.nan)
    if "confidence" in content:
        trusted = _confidence(content["confidence"], keypoints.shape[:-1], path) >= MIN_CONFIDENCE
        seen = np.isfinite(keypoints).all(-1)
        dropped = (seen & ~trusted).sum()
        if 2 * dropped > seen.sum():
            _log.warning(
                "%s: %d of %d key points have a confidence below %g, and count as unseen",
                *(path, dropped, seen.sum(), MIN_CONFIDENCE),
            )
        keypoints = np.where(trusted[..., None], keypoints, np.nan)
    lost = np.any([(keypoints == value).all(-1) for value in NOT_FOUND], axis=0)
    if lost.any():
        _log.warning("%s: %d key points at exactly (0, 0) or (-1, -1) count as unseen", path, lost.sum())
    return np.where(lost[..., None], np.nan, keypoints) + HALF_PIXEL


def _confidence(confidence: Array, shape: tuple[int, ...], path: Path) -> Array:
    if confidence.shape != shape or not np.issubdtype(confidence.dtype, np.number):
        raise ValueError(
            f"{path}: `confidence` must be numbers, one per key point, of shape {shape}; "
            f"got {confidence.dtype} {confidence.shape}"
        )
    known = confidence[~np.isnan(confidence)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    if low >= 0 and high <= MAX_CONFIDENCE:
        return confidence
    if np.isinf([low, high]).any():
        cause = "write NaN for unseen"
    elif low < 0 and high > MAX_CONFIDENCE:
        cause = "they look like logits: apply a sigmoid"
    elif low < 0:
        cause = "below zero are logits, or marks of what is unseen: apply a sigmoid, or write NaN"
    else:
        cause = "divide percent by 100, or apply a sigmoid to logits"
    raise ValueError(
        f"{path}: `confidence` must be from 0 to 1, or NaN for unseen; got {low:g} to {high:g}; {cause}"
    )


def _boxes(content: Mapping[str, Array], num_hands: int, path: Path) -> Array | None:
    if "boxes_px" not in content:
        return None
    boxes = _checked(content, "boxes_px", (num_hands, 4), path)
    lost = np.any([(boxes == value).all(-1) for value in NOT_FOUND], axis=0)
    if lost.any():
        _log.warning("%s: %d boxes of which all numbers are 0 or -1 count as unseen", path, lost.sum())
    seen = np.isfinite(boxes).all(-1) & ~lost
    empty = seen & (boxes[..., 2:] <= boxes[..., :2]).any(-1)
    if empty.any():
        frame, hand, view = (int(i) for i in np.argwhere(empty)[0])
        raise ValueError(
            f"{path}: a box is x0 y0 x1 y1 with x0 < x1 and y0 < y1 (not x y width height); got "
            f"{boxes[frame, hand, view].tolist()} (frame {frame}, hand {hand}, view {view})"
        )
    return np.where(seen[..., None], boxes, np.nan)


def _checked(content: Mapping[str, Array], name: str, tail: tuple[int, ...], path: Path) -> Array:
    """Return the array (frame, hand, view, *tail[1:]) as float64 with infinities turned to NaN."""
    array = content[name]
    expected = f"(frames, {tail[0]} hands, views, {', '.join(map(str, tail[1:]))})"
    fits = array.ndim == len(tail) + 2 and array.shape[1] == tail[0] and array.shape[3:] == tail[1:]
    if not fits or not np.issubdtype(array.dtype, np.number):
        raise ValueError(
            f"{path}: `{name}` must be numbers of shape {expected}; got {array.dtype} {array.shape}"
            f"{_layout_hint(array.shape, tail)}"
        )
    array = array.astype(np.float64)
    return np.where(np.isfinite(array), array, np.nan)


def _layout_hint(shape: tuple[int, ...], tail: tuple[int, ...]) -> str:
    """Return a fix for layouts that other tools write."""
    if shape[-2:] == (NUM_JOINTS, 3) and tail[-2:] == (NUM_JOINTS, 2):
        return "; write x and y here, and the third number, if it is a score, as `confidence`"
    if shape[3:] == tail[1:] and shape[2] == tail[0]:
        return "; views and hands are exchanged: use numpy.swapaxes(..., 1, 2)"
    return ""
