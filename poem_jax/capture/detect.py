"""2D key points of the hands of a capture, from its images alone.

Every image is looked at by itself, or a camera's images one after the other as a video; which detections are
of one hand is then decided for the whole take, by geometry (`association`).
"""

import logging
from collections.abc import Callable, Sequence

import numpy as np
from tqdm import tqdm

from poem_jax.capture.association import AssociatedHands, associate_hands
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints
from poem_jax.capture.read import image_of_camera
from poem_jax.data.capture_folder import FramePaths
from poem_jax.detection import DetectedHand, HandTracker, find_hands
from poem_jax.fitting.detector_offsets import MEDIAPIPE_HANDS
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float, UInt8

Detector = Callable[[Sequence[int], Sequence[UInt8[Array, "_ _ 3"]]], Sequence[Sequence[DetectedHand]]]
"""From the numbers of some views and their images of a frame to the hands in each."""
Found = list[Sequence[DetectedHand]]
"""The hands in every view of a frame."""

DETECTOR = "mediapipe-hands"
_MORE_IN_AN_IMAGE = 2
"""Places looked at in an image beyond the hands of the take: faces, and the hands of others."""

_log = logging.getLogger(__name__)


def detect_hands(
    frames: Sequence[FramePaths],
    rig: Rig,
    *,
    max_hands: int = 2,
    video: bool = False,
    detector: Detector | None = None,
    when_stopped: Callable[[HandBoxes], object] | None = None,
    progress: bool = True,
) -> HandBoxes:
    """Find the hands in every image of a capture.

    Args:
        frames: From `find_frames`; images that are missing or damaged see nothing (a warning names them).
        rig: The cameras.
        max_hands: Hands in the take.
        video: A hand is looked for where it was in the frame before: faster where frames follow each other
            closely.
        detector: Finds the hands in some views of a frame; None = `poem_jax.detection`.
        when_stopped: Called with the hands of the frames that are done, where there are any, when a signal
            stops the search; the `KeyboardInterrupt` then passes on.
        progress: Show a progress bar when there are several frames.

    Returns: key points (frame, hand, view, 21, 2) in the raw images, right hands first; NaN = not found, or
        beyond the image's border. They name our detector, and none where another was given.

    Raises:
        ValueError: No image can be read, no hand was found, or no two cameras agree on one.
    """
    name = MEDIAPIPE_HANDS if detector is None else None
    search = _Search(rig, _our_detector(rig.num_views, max_hands, video) if detector is None else detector)
    found: list[Found] = []
    try:
        for paths in tqdm(frames, unit="frame", disable=not progress or len(frames) == 1):
            found.append(search.look(paths))
    except KeyboardInterrupt:
        if when_stopped is not None:
            _hand_over(found, frames, rig, max_hands, name, when_stopped)
        raise
    search.report(found, len(frames))
    return _hand_boxes(found, frames, rig, max_hands, name)


class _Search:
    """Goes through the frames, and remembers what is wrong with the cameras' images."""

    def __init__(self, rig: Rig, detector: Detector) -> None:
        self._rig, self._detector = rig, detector
        self._problems: dict[int, list[FileNotFoundError | ValueError]] = {}
        self._images = np.zeros(rig.num_views, int)

    def look(self, paths: FramePaths) -> Found:
        """Return the hands in every view of a frame; the first lost image of a camera is told at once."""
        images = {}
        for view, path in enumerate(paths.images):
            try:
                if path is None:
                    raise FileNotFoundError(f"there is none of camera '{self._rig.names[view]}'")
                images[view] = image_of_camera(path, self._rig, view)
            except (FileNotFoundError, ValueError) as error:
                problems = self._problems.setdefault(view, [])
                if not problems:
                    _log.warning("frame %s: an image is left out: %s", paths.name, error)
                problems.append(error)
        self._images[list(images)] += 1
        hands = self._detector(list(images), list(images.values())) if images else []
        by_view = dict(zip(images, hands, strict=True))
        return [by_view.get(view, ()) for view in range(self._rig.num_views)]

    def report(self, found: Sequence[Found], num_frames: int) -> None:
        """Tell which cameras were of no use; raise the first problem where none was of any."""
        if not self._images.any():
            raise next(iter(self._problems.values()))[0]
        for view, problems in self._problems.items():
            if len(problems) > 1:
                name = self._rig.names[view]
                _log.warning(
                    "camera '%s': %d of %d images are left out in all", name, len(problems), num_frames
                )
        if not any(hands for frame in found for hands in frame):
            raise ValueError(
                f"no hand was found in any image of {num_frames} frames; give boxes or key points instead"
            )
        for view in np.flatnonzero(self._images):
            if not any(frame[view] for frame in found):
                _log.warning("camera '%s' shows no hand in any image: is it covered?", self._rig.names[view])


def _our_detector(num_views: int, max_hands: int, video: bool) -> Detector:
    if not video:
        return lambda views, images: find_hands(images, max_hands=max_hands + _MORE_IN_AN_IMAGE)
    trackers = [HandTracker(max_hands) for _ in range(num_views)]
    return lambda views, images: [
        trackers[view].find_hands(image) for view, image in zip(views, images, strict=True)
    ]


def _hand_over(
    found: list[Found],
    frames: Sequence[FramePaths],
    rig: Rig,
    max_hands: int,
    detector: str | None,
    when_stopped: Callable[[HandBoxes], object],
) -> None:
    """Pass on what was found so far, if it is enough to tell hands apart."""
    try:
        hands = _hand_boxes(found, frames[: len(found)], rig, max_hands, detector)
    except ValueError as error:
        _log.warning("nothing is written of the frames that were searched: %s", error)
        return
    when_stopped(hands)


def _hand_boxes(
    found: list[Found], frames: Sequence[FramePaths], rig: Rig, max_hands: int, detector: str | None
) -> HandBoxes:
    """Put what `detector` found into one track a hand."""
    names = tuple(frame.name for frame in frames)
    hands = associate_hands(found, rig, max_hands=max_hands, frame_names=names)
    for warning in hands.warnings:
        _log.warning("%s", warning)
    keypoints = _within(hands.keypoints_px, rig)
    boxes = boxes_from_keypoints(keypoints)
    return HandBoxes(boxes, hands.hand_side, names, keypoints, _confidence(hands), rig.names, detector)


def _within(
    keypoints_px: Float[Array, "frame hand view 21 2"], rig: Rig
) -> Float[Array, "frame hand view 21 2"]:
    """Return the key points with guesses beyond the image's border unseen."""
    inside = (keypoints_px >= 0) & (keypoints_px <= rig.size_wh[:, None])
    return np.where(inside.all(-1, keepdims=True), keypoints_px, np.nan)


def _confidence(hands: AssociatedHands) -> Float[Array, "frame hand view 21"]:
    return np.repeat(hands.score[..., None], hands.keypoints_px.shape[-2], axis=-1)
