"""Moments of running cameras: their newest pictures that were taken together, as the line asks for them.

Together are pictures whose times lie within half a period of the slowest camera. When the line is ready, it
gets the newest such moment; where some cameras are still to deliver theirs, it waits for them half a period
at most. What came and went meanwhile is counted as dropped.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from poem_jax.capture.live.newest import CameraState, NewestShots, Shot
from poem_jax.typing import Array, UInt8

TOGETHER = 0.5
"""Share of a period within which pictures are of one moment."""
_SLACK = 0.05
"""Of a period, by which times tremble."""
_SILENT_S, _SILENT_PERIODS = 2.0, 5
"""A camera that gave nothing for so long has stopped."""
_INSTANT_S = 1e-3
"""Not worth waiting for."""
_LOOK_S = 0.5
"""Nothing is waited for longer than this without looking at the clock."""

_log = logging.getLogger(__name__)


class Moment(NamedTuple):
    """What the cameras saw at one time."""

    number: int
    """Of all that there were; what is missing between two was dropped."""
    time_s: float
    """Seconds since the cameras began: the median of the pictures' times."""
    images: tuple[UInt8[Array, "h w 3"] | None, ...]
    """Of every camera, RGB, raw; None = it has none of this moment."""
    dropped: int
    """Moments since the last one that nobody worked on."""


class LiveMoments:
    """The moments, one whenever the next is asked for; they end when no camera delivers any more."""

    def __init__(self, shots: NewestShots, names: Sequence[str]) -> None:
        """`names`: of the cameras, for what is said of them."""
        self._shots, self._names = shots, names
        self._taken = [-1] * len(names)
        """Number of the last picture of every camera that was in a moment."""
        self._silent: set[int] = set()

    def __iter__(self) -> Iterator[Moment]:
        shots, number, last_s = self._shots, -1, -np.inf
        waiting_since: float | None = None
        while True:
            states, now = shots.states(), shots.clock()
            living = self._living(states, now)
            # Those that have just ended count, too: their last pictures are still of this moment.
            running = [state for view, state in enumerate(states) if view not in self._silent]
            period_s = max((state.period_s for state in running), default=0.0)
            views = self._newest(states, period_s, last_s)
            if views and waiting_since is None:
                waiting_since = now
            patience_s = TOGETHER * period_s - (0.0 if waiting_since is None else now - waiting_since)
            if views and (set(living) <= set(views) or patience_s < _INSTANT_S):
                chosen = {view: shot for view in views if (shot := states[view].shot) is not None}
                dropped = self._take(chosen, first=number < 0)
                number += 1 + dropped
                last_s, waiting_since = _time_of(chosen.values()), None
                images = [chosen[v].image if v in chosen else None for v in range(len(states))]
                yield Moment(number, last_s - shots.begin_s, tuple(images), dropped)
            elif not living:
                return
            else:
                shots.wait(states, patience_s if views else _LOOK_S)

    def _newest(self, states: Sequence[CameraState], period_s: float, after_s: float) -> list[int]:
        """Return the cameras of the moment that most of them show, the newest of several; none that is not
        later than `after_s` and shows something new."""
        pictures = [(state.shot.time_s, view) for view, state in enumerate(states) if state.shot is not None]
        best: tuple[int, float, list[int]] = (0, after_s, [])
        for begin_s, _ in pictures:
            end_s = begin_s + (TOGETHER + _SLACK) * period_s
            views = [view for time_s, view in pictures if begin_s <= time_s <= end_s]
            found = [shot for view in views if (shot := states[view].shot) is not None]
            is_new = any(shot.number > self._taken[v] for v, shot in zip(views, found, strict=True))
            time_s = _time_of(found)
            if is_new and time_s > after_s:
                best = max(best, (len(views), time_s, views))
        return best[2]

    def _take(self, chosen: dict[int, Shot], *, first: bool) -> int:
        """Note what is taken; return how many moments went by unseen since the last."""
        new = {view: shot.number for view, shot in chosen.items() if shot.number > self._taken[view]}
        missed = [number - self._taken[view] - 1 for view, number in new.items() if self._taken[view] >= 0]
        for view, number in new.items():
            self._taken[view] = number
        return 0 if first else min(missed, default=0)

    def _living(self, states: Sequence[CameraState], now: float) -> list[int]:
        """Return the cameras that deliver; tell of each that stops, and that is back."""
        living = []
        for view, state in enumerate(states):
            quiet_s = now - state.heard_s
            silent = not state.ended and quiet_s > max(_SILENT_S, _SILENT_PERIODS * state.period_s)
            if silent and view not in self._silent:
                self._silent.add(view)
                _log.warning("camera '%s' gave no picture for %.1f s: unseen", self._names[view], quiet_s)
            elif not silent and view in self._silent:
                self._silent.remove(view)
                _log.warning("camera '%s' is back", self._names[view])
            if not silent and not state.ended:
                living.append(view)
        return living


def _time_of(shots: Iterable[Shot]) -> float:
    return float(np.median([shot.time_s for shot in shots]))
