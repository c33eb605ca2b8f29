"""When the frames of a stream were taken: as they say, or one after the other at the rate of video."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from poem_jax.capture.frame import Frame
from poem_jax.typing import Float

SECONDS_PER_FRAME = 1 / 30
"""What video cameras take, where a capture does not say."""


def timed(frames: Iterable[Frame]) -> Iterator[tuple[float, Frame]]:
    """Pass a stream on, each frame with its moment in seconds.

    Raises:
        ValueError: Some frames have times and others have none, or a frame comes no later than the one
            before.
    """
    last: tuple[float, Frame] | None = None
    for frame in frames:
        if last is not None and (frame.time_s is None) != (last[1].time_s is None):
            known, unknown = (last[1], frame) if frame.time_s is None else (frame, last[1])
            raise ValueError(
                f"all frames of a take must have times, or none; got {known.time_s} s for frame "
                f"'{known.name}' and no time for frame '{unknown.name}'"
            )
        moment = frame.time_s
        if moment is None:
            moment = 0.0 if last is None else last[0] + SECONDS_PER_FRAME
        if last is not None and not moment > last[0]:
            raise ValueError(
                f"frames must come later and later: expected frame '{frame.name}' after {last[0]} s, the "
                f"time of frame '{last[1].name}' before it; got {moment} s. Correct the times, or leave them "
                "out"
            )
        last = moment, frame
        yield last


def times_of(frames: Sequence[Frame]) -> Float[np.ndarray, " frame"]:
    """Return the moments of successive frames, seconds; errors as `timed`."""
    return np.array([moment for moment, _ in timed(frames)])
