"""The line of a live picture: the newest moment, its hands, calmed by those before, out; then the next."""

from collections.abc import Callable, Iterator, Sequence

from poem_jax.capture.detect import Detector
from poem_jax.capture.frame import Frame
from poem_jax.capture.live.engines import LiveEngine
from poem_jax.capture.live.finding import find_in_moments
from poem_jax.capture.live.following import SIDES
from poem_jax.capture.live.messages import message_of
from poem_jax.capture.live.moments import LiveMoments
from poem_jax.capture.live.newest import NewestShots
from poem_jax.capture.live.pace import Pace
from poem_jax.capture.smoothing import Smoother, Smoothing
from poem_jax.capture.take import Take
from poem_jax.geometry.rig import Rig

Send = Callable[[str], object]
"""Takes a message away, and waits for nobody."""


def run_line(
    shots: NewestShots,
    rig: Rig,
    detector: Detector,
    engine: LiveEngine,
    smoothing: Smoothing,
    streams: Sequence[Send],
    pace: Pace,
) -> Iterator[Frame]:
    """Work on the newest moment as long as cameras deliver.

    Args:
        shots: Where the cameras leave their pictures.
        rig: The cameras.
        detector: Finds hands in the images of some views.
        engine: Finds the hands in space.
        smoothing: `causal`, or `off`.
        streams: Get the message of every moment, before its frame is yielded.
        pace: Is told of every moment.

    Returns: the frames, hands in the order of `SIDES`, as they come.
    """
    assert smoothing.mode != "offline", "a live picture cannot look ahead"
    smoother = Smoother(Take(rig, SIDES, ()), smoothing, engine.hands)
    moments = LiveMoments(shots, rig.names)
    frames = engine.run(find_in_moments(moments, rig, detector, pace))
    for frame in smoother.smooth(frames):
        message = message_of(frame) if streams else ""
        for send in streams:
            send(message)
        assert frame.time_s is not None
        pace.done(frame.time_s)
        yield frame
