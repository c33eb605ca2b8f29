"""The moments of a capture, in whichever way its folder holds them: videos, or images."""

import logging
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from poem_jax.capture.camera_folders import find_camera_folders, folder_moments
from poem_jax.capture.camera_match import match_cameras, of_cameras
from poem_jax.capture.timing import SYNC_FILE, Place, Timing, read_sync
from poem_jax.capture.video_moments import VideoMoments, open_clips
from poem_jax.data.capture_folder import SYSTEM_PREFIXES, FramePaths, find_frames, images_of_cameras
from poem_jax.geometry.rig import Rig
from poem_jax.io.video import VIDEO_SUFFIXES, VideoFrame

_FOLLOWED_FROM = 4.0
"""Frames per second from which on a hand is still near the place where it was one frame before."""
_WHOLE = Timing()

_log = logging.getLogger(__name__)


class Moments(NamedTuple):
    """The moments of a capture, of which no image was read yet."""

    frames: Sequence[FramePaths]
    frames_per_second: float | None
    """None = only the order is known."""
    is_video: bool
    """Whether they lie in videos."""
    sync: Path | None = None
    """The file of offsets and rates, where there is one."""
    whole: Sequence[FramePaths] | None = None
    """All moments of the take, where these are a part of it."""
    offsets_s: Mapping[str, float] | None = None
    """Of every camera; None = the capture says itself which images are of one moment."""

    @property
    def follow_closely(self) -> bool:
        """Whether a hand can be looked for where it was in the frame before."""
        return self.is_video and (self.frames_per_second or 0.0) >= _FOLLOWED_FROM

    def files(self) -> list[Path]:
        """Return the files of the whole take, each once."""
        frames = self.frames if self.whole is None else self.whole
        found: dict[Path, None] = {} if self.sync is None else {self.sync: None}
        for frame in [frames[0]] if self.is_video else frames:
            for image in frame.images:
                if image is not None:
                    found[image.video.path if isinstance(image, VideoFrame) else image] = None
        return list(found)


def find_moments(folder: str | os.PathLike, rig: Rig, timing: Timing = _WHOLE) -> Moments:
    """List the moments of a capture.

    Args:
        folder: With a video, or a folder of images, for each camera; or images as `find_frames` reads them.
        rig: The cameras.
        timing: Offsets, and which part of the take.

    Raises:
        FileNotFoundError: The folder, or every camera's images in it, are missing.
        ValueError: A video cannot be read or is of no camera, cameras have no moment in common, the part
            that is asked for is empty; or as `find_frames`.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no capture folder at {folder}")
    whole = _whole(folder, rig, timing)
    sync = folder / SYNC_FILE
    return _part(whole._replace(sync=sync if sync.is_file() else None), timing)


def _whole(folder: Path, rig: Rig, timing: Timing) -> Moments:
    """List all moments of a capture."""
    sync = read_sync(folder, rig.names)
    offsets_s = {**sync.offsets_s, **of_cameras(timing.offsets_s, rig.names, "--offsets")}
    every = {camera: offsets_s.get(camera, 0.0) for camera in rig.names}
    videos = _video_files(folder)
    if videos and (folder / "frames").is_dir():
        raise ValueError(
            f"{folder} holds videos ({videos[0].name}, ...) and images (frames/): move away what is not meant"
        )
    if videos:
        found = match_cameras(videos, rig.names, "videos")
        _tell_missing(found, rig, "videos", folder)
        frames = VideoMoments(open_clips(found, rig.names, offsets_s, sync.frames_per_second), rig.num_views)
        return Moments(frames, frames.frames_per_second, True, offsets_s=every)
    rate = _one_rate(sync.frames_per_second, folder)
    if not (folder / "frames").is_dir() and not any(images_of_cameras(folder, rig.names)):
        found = find_camera_folders(folder, rig.names)
        if found:
            _tell_missing(found, rig, "folders of images", folder)
            return Moments(folder_moments(found, rig.names, offsets_s, rate), rate, False, offsets_s=every)
    if any(offsets_s.values()):
        raise ValueError(
            f"{folder} says itself which images are of one moment (frames/<frame>/<camera>.jpg): offsets are "
            "for videos, and for folders of images of each camera"
        )
    frames = find_frames(folder, rig.names)
    if rate is not None:
        frames = [frame._replace(time_s=index / rate) for index, frame in enumerate(frames)]
    return Moments(frames, rate, False)


def _video_files(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in VIDEO_SUFFIXES
        and not path.name.startswith(SYSTEM_PREFIXES)
        and path.is_file()
    )


def _tell_missing(found: Mapping[str, Path], rig: Rig, what: str, folder: Path) -> None:
    missing = [camera for camera in rig.names if camera not in found]
    if not missing:
        return
    if len(found) < 2:
        raise ValueError(
            f"{folder} has {what} of {', '.join(found)} alone, none of {', '.join(missing)}: the place of a "
            "hand takes two cameras"
        )
    _log.warning("%s has no %s of %s: these cameras see nothing", folder, what, ", ".join(missing))


def _one_rate(rates: Mapping[str, float], folder: Path) -> float | None:
    if len(set(rates.values())) > 1:
        raise ValueError(
            f"{folder / SYNC_FILE}: images of one moment have one rate; `frames_per_second` gives several: "
            f"{', '.join(f'{rate:g} ({camera})' for camera, rate in rates.items())}"
        )
    return next(iter(rates.values()), None)


def _part(moments: Moments, timing: Timing) -> Moments:
    """Return the part that is asked for."""
    count = len(moments.frames)
    start = _index(timing.start, moments, "--start")
    end = count if timing.end is None else min(_index(timing.end, moments, "--end"), count)
    rows = range(start, end, timing.every)
    if not rows:
        lasts = f", {count / moments.frames_per_second:.2f} s" if moments.frames_per_second else ""
        raise ValueError(
            f"--start must be a moment of the take, which has {count} frames{lasts}, and before --end; they "
            f"are frames {start} and {end}"
        )
    if len(rows) == count:
        return moments
    rate = moments.frames_per_second
    rate = None if rate is None else rate / timing.every
    part = moments.frames[start : end : timing.every]
    return moments._replace(frames=part, frames_per_second=rate, whole=moments.frames)


def _index(place: Place, moments: Moments, option: str) -> int:
    """Return the first frame at a place or after it."""
    if place.frame is not None:
        return place.frame
    assert place.time_s is not None
    if moments.frames_per_second is None:
        raise ValueError(
            f"{option} {place.time_s:g} is in seconds, and these images have no times: give a frame "
            f'(75f), or their rate in {SYNC_FILE}: {{"frames_per_second": 30}}'
        )
    return math.ceil(place.time_s * moments.frames_per_second - 1e-6)
