"""What a worker process runs: `python -m poem_jax.mixture.worker`, requests on stdin, samples on stdout.

It ends when its stdin does, so that a run that was killed leaves nobody behind. What libraries print goes to
stderr.
"""

import os
import pickle
import signal
import sys
import traceback
from typing import BinaryIO, NamedTuple

import cv2

from poem_jax.mixture.samples import Mixture
from poem_jax.mixture.wire import receive, send


class Failure(NamedTuple):
    """An error of a sample, for the run to raise."""

    error: Exception


def serve(requests: BinaryIO, replies: BinaryIO) -> None:
    """Get a mixture, then answer (position, most_views) with what is drawn there, until the pipe ends."""
    try:
        mixture: Mixture = receive(requests)
        while True:
            position, most_views = receive(requests)
            try:
                reply = mixture.draw(position, most_views)
            except Exception as error:
                # Of any kind: the run raises it where the batch is asked for.
                reply = Failure(_portable(error))
            send(replies, reply)
    except (EOFError, BrokenPipeError):
        return


def _portable(error: Exception) -> Exception:
    """Return the error, with where it happened, as one that can be sent."""
    place = "in a data worker:\n" + "".join(traceback.format_exception(error))
    try:
        copy = pickle.loads(pickle.dumps(error))
    except Exception:
        # Exceptions may need arguments that they do not keep; their words are what counts.
        copy = RuntimeError(f"{type(error).__name__}: {error}")
    copy.add_note(place)
    return copy


def main() -> None:
    """Serve stdin and stdout."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    serve(sys.stdin.buffer, replies)


if __name__ == "__main__":
    main()
