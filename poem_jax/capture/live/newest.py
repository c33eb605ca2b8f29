"""The newest picture of every camera: what their threads leave, and the line takes when it is ready.

Times are seconds of one clock, `NewestShots.clock`. A picture that nobody took before the next one came is
gone; its number tells.
"""

import threading
import time
from collections import deque
from typing import NamedTuple

import numpy as np

from poem_jax.typing import Array, UInt8

_STEPS = 15
"""Of a camera's last steps the median is its period."""
_FEWEST_STEPS = 3
_NO_STEPS_S = 1 / 30
"""Period of a camera of which too little is known: that of video."""


class Shot(NamedTuple):
    """A picture of one camera."""

    number: int
    """Of the camera, counted without gaps where it was taken."""
    time_s: float
    image: UInt8[Array, "h w 3"]
    """RGB, raw."""


class CameraState(NamedTuple):
    """What is known of a camera."""

    shot: Shot | None
    """The newest; None = none yet."""
    heard_s: float
    """When it came; of a camera that gave none yet, when the cameras began."""
    period_s: float
    """From one picture to the next."""
    ended: bool
    """Whether no more will come."""


class NewestShots:
    """Where the cameras' threads leave their pictures; each replaces the one before."""

    def __init__(self, num_views: int) -> None:
        """`num_views`: cameras of the rig; those that have no source are ended by `end`."""
        self._changed = threading.Condition()
        self.begin_s = self.clock()
        """When the cameras began."""
        self._states = [CameraState(None, self.begin_s, _NO_STEPS_S, False) for _ in range(num_views)]
        self._steps: list[deque[float]] = [deque(maxlen=_STEPS) for _ in range(num_views)]

    def clock(self) -> float:
        """Return the time, seconds."""
        return time.monotonic()

    def put(self, view: int, shot: Shot) -> None:
        """Leave a picture, later and of a higher number than the camera's last."""
        with self._changed:
            last, steps = self._states[view].shot, self._steps[view]
            if last is not None:
                steps.append((shot.time_s - last.time_s) / (shot.number - last.number))
            period_s = float(np.median(steps)) if len(steps) >= _FEWEST_STEPS else _NO_STEPS_S
            self._states[view] = CameraState(shot, self.clock(), period_s, False)
            self._changed.notify_all()

    def end(self, view: int) -> None:
        """Tell that a camera gives no more; its last picture stays until it is stale."""
        with self._changed:
            self._states[view] = self._states[view]._replace(ended=True)
            self._changed.notify_all()

    def states(self) -> list[CameraState]:
        """Return what is known of every camera."""
        with self._changed:
            return list(self._states)

    def wait(self, seen: list[CameraState], timeout_s: float) -> None:
        """Wait for something newer than the states that were `seen`, at most so long."""
        with self._changed:
            if all(a is b for a, b in zip(seen, self._states, strict=True)):
                self._changed.wait(timeout_s)
