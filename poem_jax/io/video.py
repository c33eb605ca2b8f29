"""Video files: what they say of themselves, and their frames by time, read in order.

OpenCV decodes them (FFmpeg inside, no further dependency). A frame is asked for by its time and not by its
number, since only time stamps say which frame is which where frames are damaged, dropped or unevenly spaced.
Memory does not grow with the length: one frame of each video is held.

Time is counted from the video's first frame. A *turn* (a phone held upright stores its frames lying, with a
note to turn them) is followed or not, whichever gives the size for which the camera was calibrated.
"""

import logging
import math
import os
import threading
from pathlib import Path
from typing import NamedTuple

import cv2

from poem_jax.io.images import MAX_PIXELS, turn
from poem_jax.typing import Array, UInt8

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")
MAX_FRAMES_PER_SECOND = 10_000.0
_MAX_LOST = 300
"""Packets in a row that cannot be decoded before the video counts as ended."""
_FAR_S = 10.0
"""What lies farther ahead than this is looked for from a key frame near it."""
_BEFORE_S = 1.0
"""Looking for a time begins so much before it: what is before the next key frame cannot be decoded."""
_INEXACT_S = 0.5
"""What a file says of its length may count sound that goes on after the pictures."""
_UNEVEN = 0.5
"""Share of a period by which the step to the next frame may differ from it."""
_EXIF_OF_TURN = {0: 1, 90: 6, 180: 3, 270: 8}
"""From the clockwise turn that shows frames upright, degrees, to the orientation that means the same."""

# FFmpeg would write what it thinks of damaged frames to the terminal.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_log = logging.getLogger(__name__)


class VideoHeader(NamedTuple):
    """What is known of a video before it is read."""

    size_wh: tuple[int, int]
    """As stored, before any turn."""
    turn: int
    """Degrees clockwise by which frames are to be turned: 0, 90, 180 or 270."""
    frames_per_second: float
    last_s: float
    """When its last frame begins."""
    said_last_s: float
    """When that would be by what the file says of itself; later than `last_s` where it is cut short."""

    @property
    def is_cut_short(self) -> bool:
        """Whether the file ends earlier than it says, by more than such files are inexact."""
        return self.said_last_s - self.last_s > max(2.5 / self.frames_per_second, _INEXACT_S)

    @property
    def missing_frames(self) -> int:
        """How many frames fewer there are than the file says."""
        return max(round((self.said_last_s - self.last_s) * self.frames_per_second), 0)


class Video:
    """The frames of a video file. One thread at a time reads; going back is slow, and works."""

    def __init__(self, path: Path) -> None:
        """Open a video and find its end.

        Raises:
            FileNotFoundError: No such file.
            ValueError: It is no video that can be read, or has no frames or no frame rate.
        """
        self.path = path
        self._lock = threading.Lock()
        self._open()
        self._told_uneven = False
        self.header = self._read_header()
        self._rewind()

    def image_at(
        self, time_s: float, within_s: float, size_wh: tuple[int, int] | None = None
    ) -> UInt8[Array, "h w 3"]:
        """Return the frame nearest to a time.

        Args:
            time_s: Seconds since the video's first frame.
            within_s: How far the frame may be from it.
            size_wh: Width and height for which the camera was calibrated; None = as the file wants it shown.

        Returns: RGB.

        Raises:
            ValueError: There is no such frame, or its size is not the camera's, as is or turned.
        """
        orientation = self._orientation(size_wh)
        with self._lock:
            self._go_to(time_s)
            image = self._nearest(time_s, within_s)
        return turn(image, orientation)

    def _open(self) -> None:
        if not self.path.is_file():
            raise FileNotFoundError(f"no video at {self.path}")
        # OpenCV would add lines of its own to our error.
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        cv2.utils.logging.setLogLevel(level)
        if not self._capture.isOpened():
            raise ValueError(
                f"{self.path} cannot be read as a video ({self.path.stat().st_size} bytes): it is of another "
                "kind, or cut short before its index was written, as by a recorder that was switched off"
            )
        # Whether frames are to be turned is decided here, by the calibrated size.
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)

    def _read_header(self) -> VideoHeader:
        get = self._capture.get
        width, height = (int(get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        rate, count = get(cv2.CAP_PROP_FPS), int(get(cv2.CAP_PROP_FRAME_COUNT))
        if not 0 < width * height <= MAX_PIXELS:
            raise ValueError(
                f"{self.path} says it is {width} x {height}; a video has 1 to {MAX_PIXELS} pixels"
            )
        if not 0 < rate <= MAX_FRAMES_PER_SECOND:
            raise ValueError(f"{self.path} says that it has {rate:g} frames/s: write it anew with its rate")
        said_s = max(count - 1, 0) / rate
        last_s = self._last_s(count, rate)
        turned = round(get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        return VideoHeader((width, height), turned if turned in _EXIF_OF_TURN else 0, rate, last_s, said_s)

    def _last_s(self, count: int, rate: float) -> float:
        """Return when the last frame that is really there begins."""
        self._period_s = 1 / rate
        self._begin()
        stamps = [self._capture.get(cv2.CAP_PROP_POS_MSEC) for _ in range(2) if self._capture.grab()]
        if not stamps:
            raise ValueError(f"{self.path} has no frame that can be decoded")
        if len(set(stamps)) < len(stamps):
            raise ValueError(
                f"{self.path} has no time stamps: write it anew, as by `ffmpeg -r RATE -i IN -c copy OUT.mp4`"
            )
        # OpenCV goes as near to the place as the file reaches.
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, max(count - 2, 0))
        last_s = max(self._capture.get(cv2.CAP_PROP_POS_FRAMES) - 1, 0) * self._period_s
        while self._grab():
            last_s = self._time_s
        return last_s

    def _begin(self) -> None:
        """Forget what was read."""
        self._time_s = -math.inf
        """Of the frame that was grabbed last."""
        self._image: UInt8[Array, "h w 3"] | None = None
        """That frame, once it was asked for."""
        self._earlier: tuple[float, UInt8[Array, "h w 3"]] | None = None
        """The frame before it, if it was asked for."""
        self._end_s: float | None = None
        """Where the video was found to end."""

    def _rewind(self) -> None:
        self._capture.release()
        self._open()
        self._begin()

    def _go_to(self, time_s: float) -> None:
        """Be before the time, or at it."""
        near = time_s + self._period_s / 2
        if self._earlier is not None and self._earlier[0] <= near < self._time_s:
            return
        if self._time_s > near:
            self._rewind()
        if time_s - max(self._time_s, 0.0) > _FAR_S:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, int((time_s - _BEFORE_S) / self._period_s))
            self._begin()
            if not self._grab() or self._time_s > time_s:
                self._rewind()

    def _nearest(self, time_s: float, within_s: float) -> UInt8[Array, "h w 3"]:
        half = self._period_s / 2
        while self._end_s is None and self._time_s < time_s - half:
            is_near = abs(self._time_s - time_s) <= within_s
            self._earlier = (self._time_s, self._picture()) if is_near else None
            if not self._grab():
                self._end_s = self._time_s
        known = [(self._time_s, None)] if self._time_s >= 0 else []
        known += [self._earlier] if self._earlier is not None else []
        for at_s, image in sorted(known, key=lambda frame: abs(frame[0] - time_s)):
            if abs(at_s - time_s) <= within_s:
                return self._picture() if image is None else image
        raise ValueError(
            f"{self.path} has no frame within {within_s:.3g} s of {time_s:.3f} s: "
            + ("it ends before" if self._end_s is not None else "it is damaged there, or frames were dropped")
        )

    def _picture(self) -> UInt8[Array, "h w 3"]:
        """Return the frame that was grabbed last."""
        if self._image is None:
            done, image = self._capture.retrieve()
            if not done:
                raise ValueError(f"{self.path} cannot be decoded at {self._time_s:.3f} s")
            self._image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return self._image

    def _grab(self) -> bool:
        """Go on to the next frame that can be decoded; False at the end."""
        for lost in range(_MAX_LOST):
            if self._capture.grab():
                stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                # A damaged frame may have no time stamp, or that of another.
                time_s = stamp if stamp > self._time_s else self._time_s + (1 + lost) * self._period_s
                self._tell_if_uneven(time_s, lost)
                self._time_s, self._image = time_s, None
                return True
        return False

    def _tell_if_uneven(self, time_s: float, lost: int) -> None:
        step_s = time_s - self._time_s
        off = abs(step_s - self._period_s) > _UNEVEN * self._period_s
        if off and self._time_s >= 0 and not lost and not self._told_uneven:
            self._told_uneven = True
            _log.warning(
                "%s: its frames are not evenly spaced (the rate varies, or frames are missing): the first is "
                "%.3f s after the one before, at %.3f s, instead of %.3f s. Time stamps tell which is used",
                *(self.path, step_s, time_s, self._period_s),
            )

    def _orientation(self, size_wh: tuple[int, int] | None) -> int:
        """Return the turn that gives frames the size for which the camera was calibrated."""
        stored, degrees = self.header.size_wh, self.header.turn
        shown = stored[::-1] if degrees in (90, 270) else stored
        if size_wh is None:
            return _EXIF_OF_TURN[degrees]
        fits_stored, fits_shown = (tuple(size_wh) == size for size in (stored, shown))
        if not fits_stored and not fits_shown:
            turned = f" (to be turned by {degrees} degrees)" if degrees else ""
            raise ValueError(
                f"{self.path} is {stored[0]} x {stored[1]}{turned}; the rig was calibrated at {size_wh[0]} x "
                f"{size_wh[1]}: use videos as calibrated, or scale `K`, width and height in the rig"
            )
        if degrees and fits_stored and fits_shown:
            raise ValueError(
                f"{self.path} says that it is to be turned by {degrees} degrees, and its size fits the rig "
                "turned and not turned: the calibration may belong to either. Write it without the note, as "
                "it was calibrated: turned (`ffmpeg -i IN OUT`), or as stored (`ffmpeg -noautorotate ...`)"
            )
        return 1 if fits_stored else _EXIF_OF_TURN[degrees]


class VideoFrame(NamedTuple):
    """A frame of a video, which is read when its turn has come."""

    video: Video
    time_s: float
    """Since the video's first frame."""
    within_s: float
    """The nearest frame may be so far from it."""

    def read(self, size_wh: tuple[int, int] | None = None) -> UInt8[Array, "h w 3"]:
        """Read it; arguments and errors as `Video.image_at`."""
        return self.video.image_at(self.time_s, self.within_s, size_wh)


ImageSource = Path | VideoFrame
"""Where an image lies: in a file of its own, or in a video."""
