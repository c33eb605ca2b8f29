"""Worker processes of a mixture: they read, decode and augment; the run collects samples from them.

A pool of its own rather than Grain's: a Grain worker imports JAX (202 MB and 5 s before its first sample,
against 60 MB and 1 s here), and `multiprocessing` runs the user's script anew in every child. These are plain
subprocesses of `worker.py` that talk over pipes. An image crosses as raw bytes, one copy; at 256 x 256 that
is 0.2 MB a view, nothing beside decoding it, so there is no shared memory to leak.
"""

import os
import queue
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future
from types import TracebackType
from typing import IO

from poem_jax.mixture.samples import Drawn, Mixture
from poem_jax.mixture.wire import UNREADABLE, Failure, receive, send

_PATIENCE_S = 5.0
"""For a worker to end the sample at hand when the pool closes, before it is killed."""
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

_Task = tuple[int, int, Future]


class WorkerDied(RuntimeError):
    """A worker process ended before its work did."""


class Workers:
    """A pool of processes that draw samples; use it as a context manager. Safe to share between threads."""

    def __init__(self, mixture: Mixture, count: int) -> None:
        """Start `count` processes and send each the mixture.

        Raises:
            WorkerDied: one ended before it could take it.
        """
        self._tasks: queue.SimpleQueue[_Task | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._error: Exception | None = None
        self._processes = [_start() for _ in range(count)]
        self._threads = [
            threading.Thread(target=self._attend, args=(i,), name=f"data worker {i}", daemon=True)
            for i in range(count)
        ]
        for thread in self._threads:
            thread.start()
        try:
            for number, process in enumerate(self._processes):
                self._introduce(number, process, mixture)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Workers":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def process_ids(self) -> list[int]:
        """Of the workers."""
        return [process.pid for process in self._processes]

    def submit(self, position: int, most_views: int) -> "Future[Drawn]":
        """Ask for the sample at a position.

        The future raises what the sample raised; `WorkerDied` if a worker is gone, whichever it was.
        """
        future: Future[Drawn] = Future()
        with self._lock:
            if self._error is not None:
                raise self._error
            self._tasks.put((position, most_views, future))
        return future

    def close(self) -> None:
        """End all processes, and wait until they have ended. What was asked for and not yet drawn fails."""
        self._fail(RuntimeError("the data workers are closed"))
        for thread in self._threads:
            thread.join(_PATIENCE_S)
        for process in self._processes:
            if process.poll() is None:
                process.kill()
        for thread, process in zip(self._threads, self._processes, strict=True):
            thread.join()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                _close_quietly(pipe)

    def _introduce(self, number: int, process: subprocess.Popen[bytes], mixture: Mixture) -> None:
        assert process.stdin is not None
        try:
            send(process.stdin, mixture)
        except OSError as error:
            raise WorkerDied(_obituary(number, process, None)) from error

    def _attend(self, number: int) -> None:
        """Be the thread of one process: hand it a task, wait for the sample, hand that on."""
        process = self._processes[number]
        assert process.stdin is not None
        assert process.stdout is not None
        while (task := self._tasks.get()) is not None:
            position, most_views, future = task
            try:
                send(process.stdin, (position, most_views))
                reply = receive(process.stdout)
            except (EOFError, OSError, MemoryError, *UNREADABLE) as error:
                # The batch that waits for the sample must hear of it.
                if isinstance(error, EOFError | OSError):
                    error = WorkerDied(_obituary(number, process, position))
                future.set_exception(error)
                self._fail(error)
                return
            if isinstance(reply, Failure):
                future.set_exception(reply.error)
            else:
                future.set_result(reply)
        _close_quietly(process.stdin)

    def _fail(self, error: Exception) -> None:
        """Let all that waits fail with this error, and the threads end; the first error stays."""
        with self._lock:
            if self._error is None:
                self._error = error
            while True:
                try:
                    task = self._tasks.get_nowait()
                except queue.Empty:
                    break
                if task is not None:
                    task[2].set_exception(self._error)
            for _ in self._threads:
                self._tasks.put(None)


def _start() -> subprocess.Popen[bytes]:
    environment = {**os.environ, **dict.fromkeys(_ONE_THREAD, "1")}
    environment["PYTHONPATH"] = os.pathsep.join(path or os.getcwd() for path in sys.path)
    return subprocess.Popen(
        [sys.executable, "-m", "poem_jax.mixture.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        # Ctrl-C is the run's: it ends the workers when its step is done.
        start_new_session=True,
    )


def _obituary(number: int, process: subprocess.Popen[bytes], position: int | None) -> str:
    """Say which worker ended, how, and over what."""
    try:
        code = process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        code = process.wait()
    how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
    what = "before its first sample" if position is None else f"at sample {position} of the mixture"
    hint = (
        "; the system kills so when memory runs out: take fewer `data.mixture.processes`"
        if code == -9
        else ""
    )
    return f"data worker {number} (process {process.pid}) ended {how} {what}{hint}. Its own words are above"


def _close_quietly(pipe: IO[bytes]) -> None:
    """What is left in the buffer of a process that is gone is of no use to anybody."""
    try:
        pipe.close()
    except BrokenPipeError:
        return
