"""2D key points of the hands of a capture, from its images alone.

Every image is looked at by itself, or a camera's images one after the other as a video; which detections are
of one hand is then decided for the whole take, by geometry (`association`).
"""

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from tqdm import tqdm

from poem_jax.capture.association import AssociatedHands, associate_hands
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints
from poem_jax.capture.detections import Detections, SearchFile, within_images
from poem_jax.capture.hands_by_side import HandsBySide, hands_by_side
from poem_jax.capture.moments import Moments
from poem_jax.capture.read import ReadView, read_views
from poem_jax.capture.timing import Timing
from poem_jax.data.capture_folder import FramePaths
from poem_jax.detection import DetectedHand, HandTrackers, find_hands
from poem_jax.fitting.detector_offsets import MEDIAPIPE_HANDS
from poem_jax.geometry.rig import Rig
from poem_jax.io.reading_ahead import read_ahead
from poem_jax.typing import Array, Float, UInt8

Detector = Callable[[Sequence[int], Sequence[UInt8[Array, "_ _ 3"]]], Sequence[Sequence[DetectedHand]]]
"""From the numbers of some views and their images of a frame to the hands in each."""

_MORE_IN_AN_IMAGE = 2
"""Places looked at in an image beyond the hands of the take: faces, and the hands of others."""

_log = logging.getLogger(__name__)


def detect_hands(
    frames: Sequence[FramePaths],
    rig: Rig,
    *,
    max_hands: int = 2,
    video: bool = False,
    by_side: bool = False,
    detector: Detector | None = None,
    file: SearchFile | None = None,
    when_stopped: Callable[[HandBoxes], object] | None = None,
    progress: bool = True,
) -> HandBoxes:
    """Find the hands in every image of a capture.

    Args:
        frames: From `find_moments`; images that are missing or damaged see nothing (a warning names them).
        rig: The cameras.
        max_hands: Hands in the take.
        video: A hand is looked for where it was in the frame before: faster where frames follow each other
            closely.
        by_side: Tell hands apart by the sides that the detector names, and not by where their rays meet: to
            judge the rig.
        detector: Finds the hands in some views of a frame; None = `poem_jax.detection`.
        file: Keeps what was found; frames that it has of the same search are not searched again.
        when_stopped: Called with the hands of the frames that are done, where there are any, when a signal
            stops the search; the `KeyboardInterrupt` then passes on.
        progress: Show a progress bar when there are several frames.

    Returns: key points (frame, hand, view, 21, 2) in the raw images, right hands first; NaN = not found, or
        beyond the image's border. They name our detector, and none where another was given.

    Raises:
        ValueError: No image can be read, no hand was found, or no two cameras agree on one.
    """
    name = MEDIAPIPE_HANDS if detector is None else None

    def put_together(found: Detections) -> HandBoxes:
        return _hand_boxes(found, frames, rig, max_hands, by_side, name)

    found = Detections(rig.num_views) if file is None else file.take_up(rig.num_views)
    search = _Search(rig, _our_detector(rig.num_views, max_hands, video) if detector is None else detector)
    done = min(len(found), len(frames))
    if done:
        _log.info("%d of %d frames were searched before, and are not searched again", done, len(frames))
    rest = (frames[index] for index in range(done, len(frames)))
    hidden = not progress or len(frames) == 1
    with tqdm(total=len(frames), initial=done, unit="frame", disable=hidden) as bar:
        try:
            for paths, views in read_ahead(rest, partial(_read, rig=rig)):
                added = found.append(search.look(paths, views))
                if file is not None:
                    file.add(added)
                bar.update()
        except KeyboardInterrupt:
            if when_stopped is not None:
                _hand_over(found, put_together, when_stopped)
            raise
        finally:
            if file is not None:
                file.close()
    found = found[: len(frames)]
    search.report(found)
    return put_together(found)


def describe_search(moments: Moments, rig: Rig, timing: Timing, *, max_hands: int, video: bool) -> str:
    """Say in one line what is searched and how: what was found by the same search can be used again.

    The files are those of the whole take, and the same where names, sizes and times of their last change are.
    Where the part of the take ends does not matter: a longer search goes on from a shorter one.
    """
    import poem_jax

    files = hashlib.sha256()
    for path in moments.files():
        state = path.stat()
        files.update(f"{path.resolve()} {state.st_size} {state.st_mtime_ns}\n".encode())
    first = moments.frames[0]
    content = {
        "search": "poem detect",
        "version": poem_jax.__version__,
        "files": files.hexdigest(),
        "cameras": list(rig.names),
        "size_wh": rig.size_wh.tolist(),
        "begins": [first.name, first.time_s],
        "every": timing.every,
        "frames_per_second": moments.frames_per_second,
        "offsets_s": dict(sorted(timing.offsets_s.items())),
        "max_hands": max_hands,
        "video": video,
    }
    return json.dumps(content)


class _Search:
    """Looks at the frames, and remembers what is wrong with the cameras' images."""

    def __init__(self, rig: Rig, detector: Detector) -> None:
        self._rig, self._detector = rig, detector
        self._problems: dict[int, FileNotFoundError | ValueError] = {}
        """The first of every camera."""

    def look(self, paths: FramePaths, views: Sequence[ReadView]) -> list[Sequence[DetectedHand] | None]:
        """Return the hands in every view, None without an image; the first lost one is told at once."""
        images = {}
        for view, image in enumerate(views):
            if isinstance(image, np.ndarray):
                images[view] = image
                continue
            problem = image or FileNotFoundError(f"there is none of camera '{self._rig.names[view]}'")
            if view not in self._problems:
                self._problems[view] = problem
                _log.warning("frame %s: an image is left out: %s", paths.name, problem)
        hands = self._detector(list(images), list(images.values())) if images else []
        by_view = dict(zip(images, hands, strict=True))
        return [by_view.get(view) for view in range(self._rig.num_views)]

    def report(self, found: Detections) -> None:
        """Tell which cameras were of no use; raise the first problem where none was of any."""
        looked_at = found.looked_at
        if not looked_at.any():
            raise next(iter(self._problems.values()), ValueError("none of the images can be read"))
        for name, lost in zip(self._rig.names, (~looked_at).sum(0), strict=True):
            if lost > 1:
                _log.warning("camera '%s': %d of %d images are left out in all", name, lost, len(found))
        hands = found.hands_found.sum(0)
        if not hands.any():
            raise ValueError(
                f"no hand was found in any image of {len(found)} frames; give boxes or key points instead"
            )
        for view in np.flatnonzero(looked_at.any(0) & (hands == 0)):
            _log.warning("camera '%s' shows no hand in any image: is it covered?", self._rig.names[view])


def _read(paths: FramePaths, rig: Rig) -> list[ReadView]:
    return read_views(paths.images, rig)


def _our_detector(num_views: int, max_hands: int, video: bool) -> Detector:
    if video:
        return HandTrackers(num_views, max_hands).find_hands
    return lambda views, images: find_hands(images, max_hands=max_hands + _MORE_IN_AN_IMAGE)


def _hand_over(
    found: Detections,
    put_together: Callable[[Detections], HandBoxes],
    when_stopped: Callable[[HandBoxes], object],
) -> None:
    """Pass on what was found so far, if it is enough to tell hands apart."""
    try:
        hands = put_together(found)
    except ValueError as error:
        _log.warning("no key points are written of the frames that were searched: %s", error)
        return
    when_stopped(hands)


def _hand_boxes(
    found: Detections,
    frames: Sequence[FramePaths],
    rig: Rig,
    max_hands: int,
    by_side: bool,
    detector: str | None,
) -> HandBoxes:
    """Put what `detector` found into one track a hand."""
    searched = [frames[index] for index in range(len(found))]
    names, times = tuple(frame.name for frame in searched), [frame.time_s for frame in searched]
    if by_side:
        hands = hands_by_side(found, rig.num_views, max_hands)
    else:
        hands = associate_hands(found, rig, max_hands=max_hands, frame_names=names)
        for warning in hands.warnings:
            _log.warning("%s", warning)
    keypoints = within_images(hands.keypoints_px, rig)
    boxes = boxes_from_keypoints(keypoints)
    time_s = None if None in times else np.array(times, float)
    return HandBoxes(
        boxes, hands.hand_side, names, keypoints, _confidence(hands), rig.names, detector, time_s
    )


def _confidence(hands: AssociatedHands | HandsBySide) -> Float[Array, "frame hand view 21"]:
    return np.repeat(hands.score[..., None], hands.keypoints_px.shape[-2], axis=-1)
