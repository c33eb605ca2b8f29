"""A parent with one worker that never ends by itself, to be killed: `python -m tests.data.orphan FD`."""

import multiprocessing
import os
import sys
import time

from poem_jax.data.pack import _start_worker, _Task
from tests.data.memory_source import MemorySource


def _wait_for_ever(number: int) -> None:
    _start_worker(_Task(MemorySource(1), "DexYCB", None, 1))
    os.write(number, b"!")
    time.sleep(60)


if __name__ == "__main__":
    # Forked, so that the worker has the pipe; the threads of libraries are not needed in it.
    worker = multiprocessing.get_context("fork").Process(target=_wait_for_ever, args=(int(sys.argv[1]),))
    worker.start()
    worker.join()
