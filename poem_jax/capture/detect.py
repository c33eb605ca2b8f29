"""2D key points of the hands of a capture, from its images alone.

Every image is looked at by itself, or a camera's images one after the other as a video; which detections are
of one hand is then decided for the whole take, by geometry (`association`).
"""

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from poem_jax.capture.association import AssociatedHands, associate_hands
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints
from poem_jax.capture.folder import FramePaths
from poem_jax.capture.read import image_of_camera
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float, UInt8

if TYPE_CHECKING:
    from poem_jax.detection import DetectedHand

Images = Sequence[UInt8[Array, "_ _ 3"]]
Detector = Callable[[Sequence[int], Images], "Sequence[Sequence[DetectedHand]]"]
"""From some views' numbers and images of a frame to the hands in each."""

MAX_HANDS = 2

_log = logging.getLogger(__name__)


def detect_hands(
    frames: Sequence[FramePaths],
    rig: Rig,
    *,
    max_hands: int = MAX_HANDS,
    video: bool = False,
    detector: Detector | None = None,
    when_stopped: Callable[[HandBoxes], object] | None = None,
    progress: bool = True,
) -> HandBoxes:
    """Find the hands in every image of a capture.

    Args:
        frames: From `find_frames`; images that are missing or damaged see nothing (a warning names them).
        rig: The cameras.
        max_hands: Hands in the take, and looked for in one image.
        video: A hand is looked for where it was in the frame before: twice as fast where frames follow each
            other closely.
        detector: Finds the hands in some views of a frame; None = `poem_jax.detection`.
        when_stopped: Called with the hands of the frames that are done, where there are any, when a signal
            stops the search; the `KeyboardInterrupt` then passes on.
        progress: Show a progress bar when there are several frames.

    Returns: key points (frame, hand, view, 21, 2) in the raw images, right hands first; NaN = not found, or
        beyond the image's border.

    Raises:
        ValueError: No hand was found at all.
    """
    detector = _our_detector(rig.num_views, max_hands, video) if detector is None else detector
    found: list[list[Sequence[DetectedHand]]] = []
    try:
        for paths in tqdm(frames, unit="frame", disable=not progress or len(frames) == 1):
            found.append(_hands_of_frame(paths, rig, detector))
    except KeyboardInterrupt:
        if when_stopped is not None and any(hands for frame in found for hands in frame):
            when_stopped(_hand_boxes(found, frames[: len(found)], rig, max_hands))
        raise
    if not any(hands for frame in found for hands in frame):
        raise ValueError(
            f"no hand was found in any image of {len(frames)} frames; give boxes or key points instead"
        )
    return _hand_boxes(found, frames, rig, max_hands)


def _our_detector(num_views: int, max_hands: int, video: bool) -> Detector:
    from poem_jax.detection import HandTracker, find_hands

    if not video:
        return lambda views, images: find_hands(images, max_hands=max_hands)
    trackers = [HandTracker(max_hands) for _ in range(num_views)]
    return lambda views, images: [
        trackers[view].find_hands(image) for view, image in zip(views, images, strict=True)
    ]


def _hands_of_frame(paths: FramePaths, rig: Rig, detector: Detector) -> "list[Sequence[DetectedHand]]":
    """Return the hands in every view."""
    images = {}
    for view, path in enumerate(paths.images):
        try:
            if path is not None:
                images[view] = image_of_camera(path, rig, view)
        except (FileNotFoundError, ValueError) as error:
            _log.warning("frame %s: an image is left out: %s", paths.name, error)
    hands = dict(zip(images, detector(list(images), list(images.values())), strict=True)) if images else {}
    return [hands.get(view, ()) for view in range(rig.num_views)]


def _hand_boxes(found: Any, frames: Sequence[FramePaths], rig: Rig, max_hands: int) -> HandBoxes:
    hands = associate_hands(found, rig, max_hands=max_hands)
    for warning in hands.warnings:
        _log.warning("%s", warning)
    keypoints = _within(hands.keypoints_px, rig)
    names = tuple(frame.name for frame in frames)
    boxes = boxes_from_keypoints(keypoints)
    return HandBoxes(boxes, hands.hand_side, names, keypoints, _confidence(hands), rig.names)


def _within(keypoints_px: Float[Array, "frame hand view 21 2"], rig: Rig) -> Array:
    """Return the key points with guesses beyond the image's border unseen."""
    inside = (keypoints_px >= 0) & (keypoints_px <= rig.size_wh[:, None])
    return np.where(inside.all(-1, keepdims=True), keypoints_px, np.nan)


def _confidence(hands: AssociatedHands) -> Float[Array, "frame hand view 21"]:
    return np.repeat(hands.score[..., None], hands.keypoints_px.shape[-2], axis=-1)
