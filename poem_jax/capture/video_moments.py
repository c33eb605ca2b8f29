"""The moments of a take whose cameras wrote a video each.

They come at the rate of the slowest camera, evenly, between the latest beginning and the earliest end. Of
every camera the frame nearest by its time stamps is taken, up to half a period away: the slowest camera's own
frame lies at the moment itself unless its rate varies.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, overload

from poem_jax.capture.picked_frames import PickedFrames
from poem_jax.data.capture_folder import FramePaths
from poem_jax.io.video import Video, VideoFrame

MAX_RATIO = 10.0
"""Of the rates of two cameras: more, and one of the files names a wrong one."""
_SAME_RATE = 0.005
_WITHOUT_STAMPS = ".avi"
"""Frames of this kind of file have the time that their number in the file gives."""
_SLACK = 1e-3
"""Of a period, by which time stamps are rounded."""

_log = logging.getLogger(__name__)


class Clip(NamedTuple):
    """The video of a camera, by the common clock."""

    view: int
    """Of the rig."""
    camera: str
    video: Video
    offset_s: float
    """When its first frame was taken."""
    frames_per_second: float
    speed: float
    """Seconds of the common clock in one of the video's own: not 1 where the file names a wrong rate."""

    @property
    def last_s(self) -> float:
        """When its last frame was taken."""
        return self.offset_s + self.speed * self.video.header.last_s

    def at(self, time_s: float, within_s: float) -> VideoFrame:
        """Return the frame of a moment."""
        return VideoFrame(self.video, (time_s - self.offset_s) / self.speed, within_s / self.speed)


class VideoMoments(Sequence[FramePaths]):
    """The moments, made when they are asked for: an hour takes no more memory than a second."""

    def __init__(self, clips: Sequence[Clip], num_views: int) -> None:
        """`clips`: one or more.

        Raises:
            ValueError: They have no moment in common, or their rates cannot belong to one take.
        """
        _check_rates(clips)
        slowest = min(clips, key=lambda clip: clip.frames_per_second)
        self.frames_per_second = slowest.frames_per_second
        self._clips, self._num_views = clips, num_views
        begin_s = max(clip.offset_s for clip in clips)
        ahead = math.ceil((begin_s - slowest.offset_s) * self.frames_per_second - _SLACK)
        self._begin_s = slowest.offset_s + ahead / self.frames_per_second
        end_s = min(clip.last_s for clip in clips)
        # The last frame of another camera may serve for up to half a period after it.
        self._count = math.floor((end_s - self._begin_s) * self.frames_per_second + 0.5 - _SLACK) + 1
        if self._count < 1:
            raise ValueError(
                f"the videos have no moment in common: {_spans(clips)}; check the offsets: a camera's is how "
                "many seconds it began later than the others"
            )
        self._digits = max(4, len(str(self._count - 1)))

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> FramePaths: ...
    @overload
    def __getitem__(self, index: slice) -> PickedFrames: ...
    def __getitem__(self, index: int | slice) -> FramePaths | PickedFrames:
        """Return a moment, or those of a slice."""
        if isinstance(index, slice):
            return PickedFrames(self, range(self._count)[index])
        if not -self._count <= index < self._count:
            raise IndexError(index)
        index %= self._count
        time_s = index / self.frames_per_second
        within_s = (0.5 + _SLACK) / self.frames_per_second
        images: list[VideoFrame | None] = [None] * self._num_views
        for clip in self._clips:
            images[clip.view] = clip.at(self._begin_s + time_s, within_s)
        return FramePaths(f"{index:0{self._digits}d}", tuple(images), time_s)


def open_clips(
    videos: Mapping[str, Path],
    cameras: Sequence[str],
    offsets_s: Mapping[str, float],
    rates: Mapping[str, float],
) -> list[Clip]:
    """Open the videos of a take, in the order of the rig's cameras; say where they differ.

    Args:
        videos: By camera.
        cameras: Of the rig.
        offsets_s: By camera; zero for the others.
        rates: Frames per second by camera, in place of what the files say.

    Raises:
        FileNotFoundError, ValueError: As `Video`.
    """
    clips = []
    for view, camera in enumerate(cameras):
        if camera not in videos:
            continue
        video = Video(videos[camera])
        said = video.header.frames_per_second
        rate = rates.get(camera, said)
        clips.append(Clip(view, camera, video, offsets_s.get(camera, 0.0), rate, said / rate))
        if video.header.is_cut_short:
            _log.warning(
                "%s is cut short: it ends at %.2f s, and says that it lasts until %.2f s",
                *(video.path, video.header.last_s, video.header.said_last_s),
            )
        elif video.header.missing_frames and video.path.suffix.lower() == _WITHOUT_STAMPS:
            _log.warning(
                "%s has %d frames fewer than it says, and an AVI has no time stamps: if they are missing in "
                "its middle, what follows is too early by as much. If this camera then disagrees with the "
                "others, leave it out, or use the recording as it was before it was damaged",
                *(video.path, video.header.missing_frames),
            )
    _tell_differences(clips)
    return clips


def _check_rates(clips: Sequence[Clip]) -> None:
    rates = [clip.frames_per_second for clip in clips]
    if max(rates) > MAX_RATIO * min(rates):
        raise ValueError(
            f"the videos must have rates of one take, at most {MAX_RATIO:g} times apart; got {_rates(clips)}"
            '; where a file names a wrong one, give the true ones in sync.json: {"frames_per_second": '
            f'{{"{clips[0].camera}": 30, ...}}}}'
        )


def _tell_differences(clips: Sequence[Clip]) -> None:
    """Warn of other rates and other lengths, in a line each."""
    rates = [clip.frames_per_second for clip in clips]
    if max(rates) > (1 + _SAME_RATE) * min(rates):
        slowest = clips[rates.index(min(rates))]
        _log.warning(
            "the videos have different rates, %s: the moments are those of '%s', and the other cameras' "
            "frames up to %.0f ms away",
            *(_rates(clips), slowest.camera),
            500 / min(rate for rate in rates if rate > (1 + _SAME_RATE) * min(rates)),
        )
    period_s = 1 / min(rates)
    starts, ends = [clip.offset_s for clip in clips], [clip.last_s for clip in clips]
    if max(ends) - min(ends) > 1.5 * period_s or max(starts) - min(starts) > 1.5 * period_s:
        _log.warning(
            "the videos do not cover the same time: %s; what all have is used, %.2f s",
            *(_spans(clips), max(min(ends) - max(starts) + period_s, 0)),
        )


def _rates(clips: Sequence[Clip]) -> str:
    return ", ".join(f"{clip.frames_per_second:.4g} ({clip.camera})" for clip in clips) + " frames/s"


def _spans(clips: Sequence[Clip]) -> str:
    spans = [(clip, clip.last_s + 1 / clip.frames_per_second) for clip in clips]
    return ", ".join(f"{clip.offset_s:.2f} to {end_s:.2f} s ({clip.camera})" for clip, end_s in spans)
