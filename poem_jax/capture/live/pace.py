"""How the live line keeps up: moments there were, done and dropped, and how old their hands are."""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from poem_jax.capture.live.moments import Moment

_KEPT = 100_000
"""Moments of which delays are kept: at 30 a second those of an hour."""


class Figures(NamedTuple):
    """What is known of a stretch of time; milliseconds, NaN where nothing came out."""

    seconds: float
    offered: int
    """Moments that the cameras gave."""
    done: int
    dropped: int
    """What was offered and not done; one may be in work."""
    latency_ms: tuple[float, float]
    """From a picture to its hands: median, and what 95 of 100 stay below."""
    behind_ms: tuple[float, float]
    """From the detector's key points to the hands, likewise."""

    @property
    def rate(self) -> float:
        """Moments done in a second."""
        return self.done / self.seconds if self.seconds > 0 else 0.0

    def __str__(self) -> str:
        if not self.done:
            return f"{self.offered} moments, none done"
        return (
            f"{self.rate:.1f} moments/s; {self.done} of {self.offered} done, {self.dropped} dropped; "
            f"latency {self.latency_ms[0]:.0f} ms (95 %: {self.latency_ms[1]:.0f}); "
            f"{self.behind_ms[0]:.0f} ms (95 %: {self.behind_ms[1]:.0f}) behind the detector"
        )


class Pace:
    """Counts and measures while the line runs."""

    def __init__(self, clock: Callable[[], float], begin_s: float) -> None:
        """`clock`: that of the cameras, which began at `begin_s`."""
        self._clock, self._begin_s = clock, begin_s
        self._offered = self._done = 0
        self._detected_s = begin_s
        self._latencies_s: deque[float] = deque(maxlen=_KEPT)
        self._behind_s: deque[float] = deque(maxlen=_KEPT)
        self._lap = (begin_s, 0, 0)

    def begin(self, moment: Moment) -> None:
        """Note that a moment is worked on."""
        self._offered += 1 + moment.dropped

    def detected(self) -> None:
        """Note that its hands were found in the images."""
        self._detected_s = self._clock()

    def done(self, time_s: float) -> None:
        """Note that the hands of a moment, seconds since the cameras began, are out."""
        now = self._clock()
        self._done += 1
        self._latencies_s.append(now - self._begin_s - time_s)
        self._behind_s.append(now - self._detected_s)

    def figures(self) -> Figures:
        """Return what holds for the whole time."""
        return self._since(self._begin_s, 0, 0)

    def lap(self, seconds: float) -> Figures | None:
        """Return what holds since this last returned something, if that is `seconds` ago; else None."""
        if self._clock() - self._lap[0] < seconds:
            return None
        figures = self._since(*self._lap)
        self._lap = self._clock(), self._offered, self._done
        return figures

    def _since(self, time_s: float, offered: int, done: int) -> Figures:
        count = self._done - done
        kept = (self._latencies_s, self._behind_s)
        delays = [_quantiles_ms(list(each)[-count:] if count else []) for each in kept]
        there_were = self._offered - offered
        seconds = self._clock() - time_s
        return Figures(seconds, there_were, count, there_were - count, delays[0], delays[1])


def _quantiles_ms(delays_s: list[float]) -> tuple[float, float]:
    if not delays_s:
        return float("nan"), float("nan")
    median, most = np.quantile(delays_s, (0.5, 0.95))
    return float(1000 * median), float(1000 * most)
