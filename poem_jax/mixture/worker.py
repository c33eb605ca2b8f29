"""What a worker process runs: `python -m poem_jax.mixture.worker`, requests on stdin, samples on stdout.

It ends when its stdin does, and at nothing else: a run that was killed leaves nobody behind, and one that is
asked to stop, by a signal to all its processes, can finish its step. What libraries print goes to stderr.
"""

import os
import pickle
import signal
import sys
import traceback
from typing import IO

import cv2

from poem_jax.mixture.samples import Mixture
from poem_jax.mixture.wire import UNREADABLE, Failure, receive, send

ERRORS_OF_SAMPLES = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    cv2.error,
)
"""What the run hears where the batch is asked for; any other error ends the worker, and the run with it."""


def serve(requests: IO[bytes], replies: IO[bytes]) -> None:
    """Get a mixture, then answer (position, most_views) with what is drawn there, until the pipe ends."""
    try:
        mixture: Mixture = receive(requests)
        while True:
            position, most_views = receive(requests)
            try:
                reply = mixture.draw(position, most_views)
            except ERRORS_OF_SAMPLES as error:
                reply = Failure(_portable(error))
            send(replies, reply)
    except (EOFError, BrokenPipeError):
        return


def _portable(error: Exception) -> Exception:
    """Return the error, with where it happened, as one that can be sent."""
    place = "in a data worker:\n" + "".join(traceback.format_exception(error))
    try:
        copy = pickle.loads(pickle.dumps(error))
    except UNREADABLE:
        # Exceptions may need arguments that they do not keep; their words are what counts.
        copy = RuntimeError(f"{type(error).__name__}: {error}")
    copy.add_note(place)
    return copy


def main() -> None:
    """Serve stdin and stdout."""
    for kind in (signal.SIGINT, signal.SIGTERM):
        signal.signal(kind, signal.SIG_IGN)
    cv2.setNumThreads(1)
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    serve(sys.stdin.buffer, replies)


if __name__ == "__main__":
    main()
