"""How a run is stopped from outside: after the step under way, with a checkpoint."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from poem_jax.io.stopping import Stopped


@contextmanager
def stop_after_the_step() -> Iterator[threading.Event]:
    """Turn SIGTERM and SIGINT into an event, so that the step under way and its checkpoint are finished.

    Then `Stopped` is raised; at a second signal at once.
    """
    event = threading.Event()
    received: list[signal.Signals] = []

    def note(number: int, frame: FrameType | None) -> None:
        if received:
            raise Stopped(signal.Signals(number))
        received.append(signal.Signals(number))
        event.set()
        # Not by `logging`: the signal may have come while a line was being written.
        os.write(2, b"stopping after this step, with a checkpoint; once more: at once\n")

    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    previous = {kind: signal.signal(kind, note) for kind in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield event
    finally:
        for kind, handler in previous.items():
            signal.signal(kind, handler)
    if received:
        raise Stopped(received[0])
