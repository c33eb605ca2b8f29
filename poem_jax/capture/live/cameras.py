"""Cameras that OpenCV opens, by a device's number or by a URL; a thread each keeps the newest picture."""

import logging
import os
import threading
from collections.abc import Mapping

import cv2

from poem_jax.capture.live.newest import NewestShots, Shot
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, UInt8

_TIMEOUT_MS = 8000
"""After which a URL that does not answer is given up."""
_CLOSE_S = 2.0

# FFmpeg would write what it thinks of a stream to the terminal.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_log = logging.getLogger(__name__)


class Cameras:
    """The cameras of a rig, or some of them."""

    def __init__(self, addresses: Mapping[str, str], rig: Rig) -> None:
        """Open the cameras.

        Args:
            addresses: By the camera's name: the number of a device, or a URL.
            rig: The rig; its sizes are asked of devices. Cameras that have no address see nothing.

        Raises:
            ConnectionError: A camera cannot be opened, or gives no picture.
            ValueError: It gives pictures of another size than it was calibrated at.
        """
        self._rig = rig
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._open: dict[int, cv2.VideoCapture] = {}
        try:
            for name, address in addresses.items():
                view = rig.names.index(name)
                self._open[view] = _opened(name, address, self._size_wh(view))
        except (ConnectionError, ValueError):
            self.close()
            raise

    def start(self, shots: NewestShots) -> None:
        """Begin to keep their newest pictures."""
        for view, name in enumerate(self._rig.names):
            if view not in self._open:
                shots.end(view)
                continue
            thread = threading.Thread(
                target=self._watch, args=(view, shots), name=f"camera-{name}", daemon=True
            )
            self._threads.append(thread)
            thread.start()

    def close(self) -> None:
        """End all threads; one that hangs in its camera is left behind."""
        self._stop.set()
        for thread in self._threads:
            thread.join(_CLOSE_S)
        if not any(thread.is_alive() for thread in self._threads):
            for capture in self._open.values():
                capture.release()

    def _size_wh(self, view: int) -> tuple[int, int]:
        width, height = self._rig.size_wh[view]
        return int(width), int(height)

    def _watch(self, view: int, shots: NewestShots) -> None:
        number, name, capture = 0, self._rig.names[view], self._open[view]
        while not self._stop.is_set():
            done, image = capture.read()
            time_s = shots.clock()
            if not done:
                _log.warning("camera '%s' delivers no more: unseen", name)
                break
            if (fault := _wrong_size(image, self._size_wh(view))) is not None:
                _log.warning("camera '%s' %s: unseen from here", name, fault)
                break
            shots.put(view, Shot(number, time_s, cv2.cvtColor(image, cv2.COLOR_BGR2RGB)))
            number += 1
        shots.end(view)


def _opened(name: str, address: str, size_wh: tuple[int, int]) -> cv2.VideoCapture:
    """Open a camera, see to its size, and take a first picture."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        if address.isdecimal():
            capture = cv2.VideoCapture(int(address))
        else:
            timeouts = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC)
            options = [value for timeout in timeouts for value in (timeout, _TIMEOUT_MS)]
            capture = cv2.VideoCapture(address, cv2.CAP_FFMPEG, options)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        what = f"device {address}" if address.isdecimal() else address
        raise ConnectionError(
            f"camera '{name}' cannot be opened: {what} is not there, is used by another program, or may not "
            "be used by you"
        )
    if address.isdecimal():
        # Devices start with a size of their own choice, and keep pictures waiting.
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_wh[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_wh[1])
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    done, image = capture.read()
    if not done:
        capture.release()
        raise ConnectionError(f"camera '{name}' ({address}) is open, but gives no picture")
    if (fault := _wrong_size(image, size_wh)) is not None:
        capture.release()
        raise ValueError(f"camera '{name}' ({address}) {fault}")
    return capture


def _wrong_size(image: UInt8[Array, "h w 3"], size_wh: tuple[int, int]) -> str | None:
    """Say what is wrong with a picture's size, None where it is as calibrated."""
    height, width = image.shape[:2]
    if (width, height) == size_wh:
        return None
    return (
        f"gives pictures of {width} x {height}, and the rig was calibrated at {size_wh[0]} x {size_wh[1]}: "
        "set the camera to that size, or calibrate at the one it gives"
    )
