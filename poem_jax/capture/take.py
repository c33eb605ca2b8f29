"""What a capture holds: cameras, hands, and its frames, of which no image is read before its turn."""

import logging
import os
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.capture.boxes_file import (
    HOW_TO_GET_BOXES,
    HandBoxes,
    align_boxes,
    read_boxes,
    without_boxes_outside,
)
from poem_jax.capture.camera_match import of_cameras
from poem_jax.capture.frame import Frame
from poem_jax.capture.moments import Moments, find_moments
from poem_jax.capture.picked_frames import PickedFrames
from poem_jax.capture.timing import Timing, read_sync
from poem_jax.data.capture_folder import FramePaths, find_rig, frame_key, hand_names
from poem_jax.geometry.rig import Rig
from poem_jax.io.file_names import name_key, safe_file_names

_SAME_OFFSET_S = 1e-6

BOXES_FILES = ("boxes.npz", "keypoints.npz")

_log = logging.getLogger(__name__)


class Take(NamedTuple):
    """A capture: one moment or many."""

    rig: Rig
    hand_sides: tuple[str, ...]
    """'left' or 'right' of every hand that is followed through the take."""
    frames: Iterable[Frame]
    """In order, taken one after the other; how many there are need not be known."""
    detector: str | None = None
    """What found the key points, as their file names it; None = it does not say."""
    frames_per_second: float | None = None
    """Of the frames as taken; None = only their order is known."""

    @property
    def hand_names(self) -> tuple[str, ...]:
        """One name per hand, which serves as a file name: its side, numbered where one comes twice."""
        return hand_names(self.hand_sides)

    @property
    def num_frames(self) -> int | None:
        """How many frames there are, None where only the end of the stream tells."""
        return len(self.frames) if isinstance(self.frames, Sized) else None


@dataclass(frozen=True)
class StoredFrames:
    """The frames of a capture on disk, to be gone through any number of times."""

    paths: Sequence[FramePaths]
    hands: HandBoxes
    """Aligned with `paths`."""

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> Iterator[Frame]:
        hands = self.hands
        for index, (name, images, time_s) in enumerate(self.paths):
            keypoints = None if hands.keypoints_px is None else hands.keypoints_px[index]
            confidence = None if hands.confidence is None else hands.confidence[index]
            if hands.time_s is not None and np.isfinite(hands.time_s[index]):
                time_s = float(hands.time_s[index])
            yield Frame(name, hands.boxes_px[index], keypoints, confidence, images, time_s=time_s)


def read_take(
    folder: str | os.PathLike,
    rig: str | os.PathLike | None = None,
    boxes: str | os.PathLike | None = None,
    timing: Timing | None = None,
) -> Take:
    """Read rig and boxes of a capture, and list its frames.

    Args:
        folder: With a video, or a folder of images, for each camera; with one image for each, or
            `frames/<frame>/<camera>.jpg`.
        rig: Rig file; None = `rig.json` or `calibration/rig.json` in the folder.
        boxes: File of boxes or key points; None = `boxes.npz` in the folder.
        timing: The cameras' offsets, and which part of the take; None = all of it.

    Raises:
        FileNotFoundError: Folder, rig, boxes or images are missing.
        ValueError: One of them is wrong.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no capture folder at {folder}")
    found = find_rig(folder, rig)
    boxes_file = boxes_beside(folder) if boxes is None else Path(boxes)
    if boxes_file is None:
        looked = " or ".join(str(folder / name) for name in BOXES_FILES)
        raise FileNotFoundError(f"no {looked}: {HOW_TO_GET_BOXES}")
    hands = read_boxes(boxes_file)
    moments = _moments_of(hands, folder, found, Timing() if timing is None else timing, boxes_file)
    names = [frame.name for frame in moments.frames]
    hands = align_boxes(hands, names, found.names, boxes_file)
    return make_take(found, moments.frames, hands, moments.frames_per_second)


def boxes_beside(folder: Path) -> Path | None:
    """Return the file of boxes in a capture's folder, None where there is none."""
    return next((folder / name for name in BOXES_FILES if (folder / name).is_file()), None)


def read_keypoint_take(
    keypoints: str | os.PathLike,
    rig: str | os.PathLike | None = None,
    images: str | os.PathLike | None = None,
    timing: Timing | None = None,
) -> Take:
    """Read key points and rig; the frames are those of the key-point file.

    Args:
        keypoints: File of key points.
        rig: Rig file; None = `rig.json` or `calibration/rig.json` in the folder `images` where that is given,
            else beside the key points.
        images: Capture folder to draw on, as for `read_take`; its frames are found by name. None = no images.
        timing: The cameras' offsets, where the images are videos; the part of the take is the key points'.

    Raises:
        FileNotFoundError: A file, or every image, is missing.
        ValueError: One of them is wrong, they have different numbers of views, or no name of a frame fits.
    """
    found = find_rig(Path(keypoints).parent if images is None else images, rig)
    hands = read_boxes(keypoints)
    if hands.keypoints_px is None:
        raise ValueError(
            f"{keypoints} holds boxes only; a fit needs `keypoints_px (F, H, V, 21, 2)`, OpenPose order"
        )
    if images is None:
        moments = Moments([], None, False)
    else:
        offsets = Timing() if timing is None else Timing(timing.offsets_s)
        moments = _moments_of(hands, images, found, offsets, keypoints)
    pictures = [frame.name for frame in moments.frames]
    _check_numbers_differ(pictures)
    if hands.frames is None and len(pictures) not in (0, len(hands.boxes_px)):
        _log.warning(
            "%s names none of its %d frames, and %s has %d: its images are taken by their numbers from 0000; "
            "add `frames (F,)` with the frames' names to the file to say which is which",
            *(keypoints, len(hands.boxes_px), images, len(pictures)),
        )
    names = hands.frames or _frame_names(len(hands.boxes_px), pictures)
    hands = align_boxes(hands, names, found.names, keypoints)
    by_key = {frame_key(name): row for row, name in enumerate(pictures)}
    rows = [by_key.get(frame_key(name), -1) for name in names]
    if len(pictures) == len(names) == 1:
        rows = [0]
    if pictures and max(rows) < 0:
        raise ValueError(
            f"{images}: no frame of it ({', '.join(pictures[:3])}) is among those of {keypoints} "
            f"({', '.join(names[:3])})"
        )
    paths = PickedFrames(moments.frames, rows, names, found.num_views)
    return make_take(found, paths, hands, _rate_of_rows(rows, moments))


def found_at(hands: HandBoxes, moments: Moments) -> HandBoxes:
    """Note the offsets under which the images were put together that hands were found in."""
    if moments.offsets_s is None:
        return hands
    return hands._replace(offsets_s=np.array(list(moments.offsets_s.values())))


def _moments_of(
    hands: HandBoxes, folder: str | os.PathLike, rig: Rig, timing: Timing, path: str | os.PathLike
) -> Moments:
    """List the moments of a capture, under the offsets under which its hands were found if these are noted.

    Raises: ValueError: The offsets that are asked for are others; or as `find_moments`.
    """
    if hands.offsets_s is None:
        if any(timing.offsets_s.values()):
            _log.warning(
                "%s does not say under which offsets its hands were found: they are taken to be those given",
                path,
            )
        return find_moments(folder, rig, timing)
    asked = {
        **read_sync(folder, rig.names).offsets_s,
        **of_cameras(timing.offsets_s, rig.names, "--offsets"),
    }
    by_key = dict(zip(map(name_key, hands.cameras or rig.names), hands.offsets_s.tolist(), strict=False))
    noted = {camera: by_key[name_key(camera)] for camera in rig.names if name_key(camera) in by_key}
    other = [camera for camera in noted if abs(noted[camera] - asked.get(camera, 0.0)) > _SAME_OFFSET_S]
    if not other:
        return find_moments(folder, rig, timing)
    told = f"{other[0]}={noted[other[0]]:g}, not {asked.get(other[0], 0.0):g}"
    if timing.offsets_s:
        raise ValueError(
            f"{path}: its hands were found under other offsets ({told} s): move it away to search again, or "
            "leave --offsets out"
        )
    _log.warning(
        "%s: the images are taken under the offsets under which its hands were found: %s", path, told
    )
    return find_moments(folder, rig, replace(timing, offsets_s=noted))


def make_take(
    rig: Rig, paths: Sequence[FramePaths], hands: HandBoxes, frames_per_second: float | None = None
) -> Take:
    """Put a take together; boxes that lie wholly outside their image count as unseen.

    Args:
        rig: The cameras.
        paths: The frames.
        hands: Aligned with them.
        frames_per_second: None = by the times of `hands`, where it has them.

    Raises: ValueError: The name of a frame cannot be that of a folder, or comes twice, if only as a number.
    """
    names = safe_file_names([frame.name for frame in paths], "names of frames")
    _check_numbers_differ(names)
    frames = StoredFrames(paths, without_boxes_outside(hands, rig.size_wh))
    if frames_per_second is None:
        frames_per_second = _rate_of_times(hands)
    return Take(rig, hands.hand_side, frames, hands.detector, frames_per_second)


def _rate_of_rows(rows: Sequence[int], moments: Moments) -> float | None:
    """Return the rate of the frames that key points have of a take: every so many of its own."""
    steps = np.diff([row for row in rows if row >= 0])
    if moments.frames_per_second is None or not len(steps) or np.median(steps) <= 0:
        return moments.frames_per_second
    return moments.frames_per_second / float(np.median(steps))


def _rate_of_times(hands: HandBoxes) -> float | None:
    steps = np.zeros(0) if hands.time_s is None else np.diff(hands.time_s[np.isfinite(hands.time_s)])
    return 1 / float(np.median(steps)) if len(steps) else None


def in_groups(frames: Iterable[Frame], size: int) -> Iterator[list[Frame]]:
    """Cut a stream into lists of `size` frames, the last one shorter."""
    group: list[Frame] = []
    for frame in frames:
        group.append(frame)
        if len(group) == size:
            yield group
            group = []
    if group:
        yield group


def _check_numbers_differ(names: Iterable[str]) -> None:
    """Raise ValueError if two names are those of one frame, as '9' and '0009' are."""
    by_key: dict[str | int, str] = {}
    for name in names:
        other = by_key.setdefault(frame_key(name), name)
        if other != name:
            raise ValueError(
                f"frames must have different numbers; {other!r} and {name!r} have one: rename one"
            )


def _frame_names(count: int, pictures: Sequence[str]) -> tuple[str, ...]:
    """Name frames that the file does not: as those of the images where these are as many, else by number."""
    if len(pictures) == count:
        return tuple(pictures)
    return tuple(f"{index:04d}" for index in range(count))
