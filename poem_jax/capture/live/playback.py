"""A recorded take played as if its cameras ran: every picture comes when it was taken, at the take's rate."""

import logging
import math
import threading
from collections.abc import Sequence

import numpy as np

from poem_jax.capture.live.newest import NewestShots, Shot
from poem_jax.capture.moments import Moments
from poem_jax.capture.read import read_views
from poem_jax.data.capture_folder import FramePaths
from poem_jax.geometry.rig import Rig

_log = logging.getLogger(__name__)


class Playback:
    """Plays a take, a thread for each camera; a picture that is late already is passed over."""

    def __init__(self, moments: Moments, rig: Rig, *, loop: bool = False) -> None:
        """Prepare it.

        Args:
            moments: The take.
            rig: Its cameras.
            loop: Begin again at the end.

        Raises:
            ValueError: The take has no rate.
        """
        if moments.frames_per_second is None:
            raise ValueError(
                "only the order of the source's images is known, not when they were taken: give their rate "
                'in sync.json, {"frames_per_second": 30}, or take videos'
            )
        self._frames: Sequence[FramePaths] = moments.frames
        self._rig, self._loop = rig, loop
        self._period_s = 1 / moments.frames_per_second
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self, shots: NewestShots) -> None:
        """Begin to play; the first pictures are of this moment."""
        begin_s = shots.clock()
        for view, name in enumerate(self._rig.names):
            thread = threading.Thread(
                target=self._play, args=(view, shots, begin_s), name=f"play-{name}", daemon=True
            )
            self._threads.append(thread)
            thread.start()

    def close(self) -> None:
        """End all threads."""
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _play(self, view: int, shots: NewestShots, begin_s: float) -> None:
        number, told = 0, False
        while self._loop or number < len(self._frames):
            due_s = begin_s + number * self._period_s
            if self._stop.wait(max(due_s - shots.clock(), 0.0)):
                break
            image = self._read(view, number % len(self._frames))
            if isinstance(image, np.ndarray):
                shots.put(view, Shot(number, due_s, image))
            elif image is not None and not told:
                told = True
                _log.warning("camera '%s': a picture is left out: %s", self._rig.names[view], image)
            number = max(number + 1, math.floor((shots.clock() - begin_s) / self._period_s))
        shots.end(view)

    def _read(self, view: int, index: int) -> object:
        """Return a picture, the reason why it is lost, or None where the camera has none."""
        source = self._frames[index].images[view]
        return read_views([source if v == view else None for v in range(self._rig.num_views)], self._rig)[
            view
        ]
