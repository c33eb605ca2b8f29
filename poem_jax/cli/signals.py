"""How a command ends that is asked to stop, or whose reader has gone away."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any, TextIO

from poem_jax.io.stopping import Stopped

USAGE_ERROR = 2
"""Exit code for wrong input."""
STOPPED = 128
"""What the number of the signal that ended a program is added to, for its exit code."""

_SOON_S = 0.05


@contextlib.contextmanager
def stop_on_signals() -> Iterator[None]:
    """Turn SIGINT (Ctrl-C) and SIGTERM into `Stopped`, so that a command can keep what it has done."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise Stopped(signal.Signals(number))

    previous = {kind: signal.signal(kind, stop) for kind in (signal.SIGINT, signal.SIGTERM)}
    sys.unraisablehook, report = _again_when_lost, sys.unraisablehook
    try:
        yield
    finally:
        sys.unraisablehook = report
        for kind, handler in previous.items():
            signal.signal(kind, handler)


def _again_when_lost(lost: Any) -> None:
    """Send a signal once more that came in a callback of the garbage collector, where exceptions are lost."""
    if isinstance(lost.exc_value, Stopped):
        threading.Timer(_SOON_S, os.kill, (os.getpid(), lost.exc_value.signal)).start()
    else:
        sys.__unraisablehook__(lost)


def exit_code(request: KeyboardInterrupt) -> int:
    """Return the exit code of a command that a signal stopped: 130 for Ctrl-C, 143 for SIGTERM."""
    return STOPPED + (request.signal if isinstance(request, Stopped) else signal.SIGINT)


class UntilReaderLeaves:
    """A text stream that goes quiet when nobody reads it any more, as in `poem ... | head`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or drop the text."""
        with self._quiet():
            return self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Pass on what is buffered, or drop it."""
        with self._quiet():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextlib.contextmanager
    def _quiet(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            # What is still buffered, and all that follows, goes nowhere.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
