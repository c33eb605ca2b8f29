"""What measures: `python -m tools.accelerator.worker`, rows on stdin, their figures on stdout.

It ends when its stdin does. What libraries print goes to stderr. A row that does not fit into memory is an
answer; whatever else goes wrong ends the process, and says so on stderr.
"""

import os
import re
import signal
import sys
from typing import IO

from poem_jax.mixture.wire import Failure, receive, send
from tools.accelerator.results import Figures
from tools.accelerator.rows import Row

_OUT_OF_MEMORY = re.compile("RESOURCE_EXHAUSTED|out.of.memory", re.IGNORECASE)


def serve(requests: IO[bytes], replies: IO[bytes]) -> None:
    """Answer every row with its figures, or with a `Failure`, until the pipe ends."""
    try:
        while True:
            send(replies, _answer(receive(requests)))
    except (EOFError, BrokenPipeError):
        return


def _answer(row: Row) -> Figures | Failure:
    import jax

    try:
        return row.measure()
    except jax.errors.JaxRuntimeError as error:
        # XLA's words are long; of memory their first line says what was asked for.
        words = str(error).strip()
        kind = MemoryError if _OUT_OF_MEMORY.search(words) else RuntimeError
        return Failure(kind(words.splitlines()[0][:300]))
    finally:
        jax.clear_caches()


def main() -> None:
    """Serve stdin and stdout; Ctrl-C is the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    from poem_jax.io.compilation_cache import use_compilation_cache

    use_compilation_cache()
    serve(sys.stdin.buffer, replies)


if __name__ == "__main__":
    main()
