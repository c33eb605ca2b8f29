"""2D key points of both hands from images, by MediaPipe Hands: the paper's detector for real captures.

MediaPipe is an extra (`pip install 'poem-jax[detect]'`), imported only here; 0.10.14 carries its models.
Every image is looked at by itself (static mode, the full model, at most two hands). MediaPipe names sides as
if images were mirrored, as those of a selfie camera are; ours are not, so left and right change places.
"""

import importlib
import importlib.util
import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints
from poem_jax.capture.folder import FramePaths
from poem_jax.geometry.rig import Rig
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.io.images import read_image
from poem_jax.typing import Array, Float, UInt8

HOW_TO_GET_DETECTION = "finding hands in images needs MediaPipe: pip install 'poem-jax[detect]'"
SIDES = ("right", "left")
MIN_DETECTION_CONFIDENCE = 0.5

_SIDE_OF_LABEL = {"Left": "right", "Right": "left"}
_FULL_MODEL = 1
_SAME_PLACE = 0.5

_log = logging.getLogger(__name__)


class Detection(NamedTuple):
    """One hand that a detector found in one image."""

    side: str
    score: float
    """How sure the detector is of the side."""
    keypoints_px: Float[Array, "21 2"]
    """OpenPose order, pixels of the image, which spans [0, W] x [0, H]."""


def detect_hands(
    frames: Sequence[FramePaths],
    rig: Rig,
    *,
    detector: Callable[[UInt8[Array, "h w 3"]], Sequence[Detection]] | None = None,
    when_stopped: Callable[[HandBoxes], object] | None = None,
    progress: bool = True,
) -> HandBoxes:
    """Find one right and one left hand in every image of a capture.

    Args:
        frames: From `find_frames`; images that are missing or damaged see nothing (a warning names them).
        rig: The cameras.
        detector: Finds the hands of an RGB image; None = MediaPipe.
        when_stopped: Called with the hands of the frames that are done, where there are any, when a signal
            stops the search; the `KeyboardInterrupt` then passes on.
        progress: Show a progress bar when there are several frames.

    Returns: key points (frame, 2, view, 21, 2) in the raw images, right hand first; NaN = not found.

    Raises:
        ModuleNotFoundError: MediaPipe is not installed.
        ValueError: No hand was found at all.
    """
    detector = _mediapipe_detector() if detector is None else detector
    keypoints = np.full((len(frames), len(SIDES), rig.num_views, NUM_JOINTS, 2), np.nan)
    names = tuple(frame.name for frame in frames)
    done = 0
    try:
        for paths in tqdm(frames, unit="frame", disable=not progress or len(frames) == 1):
            keypoints[done] = _hands_of_frame(paths, rig, detector)
            done += 1
    except KeyboardInterrupt:
        if when_stopped is not None and np.isfinite(keypoints[:done]).any():
            when_stopped(_hand_boxes(keypoints[:done], names[:done]))
        raise
    if np.isnan(keypoints).all():
        raise ValueError(
            f"no hand was found in any image of {len(frames)} frames; give boxes or key points instead"
        )
    return _hand_boxes(keypoints, names)


def _hand_boxes(keypoints: Float[Array, "frame 2 view 21 2"], names: tuple[str, ...]) -> HandBoxes:
    return HandBoxes(boxes_from_keypoints(keypoints), SIDES, names, keypoints)


def _hands_of_frame(
    paths: FramePaths, rig: Rig, detector: Callable[[UInt8[Array, "h w 3"]], Sequence[Detection]]
) -> Float[Array, "2 view 21 2"]:
    keypoints = np.full((len(SIDES), rig.num_views, NUM_JOINTS, 2), np.nan)
    for view, path in enumerate(paths.images):
        if path is None:
            continue
        try:
            image = read_image(path, (int(rig.size_wh[view][0]), int(rig.size_wh[view][1])))
        except (FileNotFoundError, ValueError) as error:
            _log.warning("frame %s: an image is left out: %s", paths.name, error)
            continue
        for side, found in one_of_each_side(detector(image)).items():
            keypoints[SIDES.index(side), view] = found.keypoints_px
    return keypoints


def one_of_each_side(detections: Sequence[Detection]) -> dict[str, Detection]:
    """Return at most one detection per side, the surest first.

    A second detection of one side is the other hand, if that was not found and lies elsewhere; else it is the
    same hand again.
    """
    kept: dict[str, Detection] = {}
    claimed = {found.side for found in detections}
    for found in sorted(detections, key=lambda found: -found.score):
        if found.side not in kept:
            kept[found.side] = found
            continue
        (other,) = (side for side in SIDES if side != found.side)
        if other not in claimed and other not in kept and not _overlap(found, kept[found.side]):
            kept[other] = found._replace(side=other)
    return kept


def _overlap(a: Detection, b: Detection) -> bool:
    """Tell whether two detections are of one place: the boxes' intersection is over half of their union."""
    boxes = np.asarray(boxes_from_keypoints(np.stack([a.keypoints_px, b.keypoints_px])))
    shared = np.clip(boxes[:, 2:].min(0) - boxes[:, :2].max(0), 0, None).prod()
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(-1)
    return bool(shared > _SAME_PLACE * (areas.sum() - shared))


def _inside(shares: Float[Array, "21 2"]) -> Float[Array, "21 2"]:
    """Return shares of the image's size; NaN for guesses beyond its border."""
    inside = ((shares >= 0) & (shares <= 1)).all(-1, keepdims=True)
    return np.where(inside, shares, np.nan)


def _mediapipe_detector() -> Callable[[UInt8[Array, "h w 3"]], Sequence[Detection]]:
    if importlib.util.find_spec("mediapipe") is None:
        raise ModuleNotFoundError(HOW_TO_GET_DETECTION)
    # By name: type checkers run where the extra is not installed.
    hands = importlib.import_module("mediapipe").solutions.hands.Hands(
        static_image_mode=True,
        max_num_hands=len(SIDES),
        model_complexity=_FULL_MODEL,
        min_detection_confidence=MIN_DETECTION_CONFIDENCE,
    )

    def detect(image: UInt8[Array, "h w 3"]) -> list[Detection]:
        height, width = image.shape[:2]
        found = hands.process(np.ascontiguousarray(image))
        hand_landmarks: list[Any] = found.multi_hand_landmarks or []
        handedness: list[Any] = found.multi_handedness or []
        detections = []
        for hand, sides in zip(hand_landmarks, handedness, strict=True):
            named = sides.classification[0]
            shares = np.array([[point.x, point.y] for point in hand.landmark])
            keypoints = _inside(shares) * np.array([width, height])
            detections.append(Detection(_SIDE_OF_LABEL[named.label], named.score, keypoints))
        return detections

    return detect
