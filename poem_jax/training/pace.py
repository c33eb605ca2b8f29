"""How fast a run goes, what it waits for, and how much memory it has taken."""

import resource
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from types import TracebackType

import jax

from poem_jax.typing import Array


class Pace:
    """Counts steps and samples between two readings; use it as a context manager.

    The loop asks for a batch while a step runs, so that the time it stands in `waiting` says little: what
    counts is the part of it in which the devices had nothing to do. A thread notes when each step ends.
    """

    def __init__(self) -> None:
        self._watcher = ThreadPoolExecutor(1, thread_name_prefix="pace")
        self._end: Future[float] | None = None
        self.restart()

    def __enter__(self) -> "Pace":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._watcher.shutdown(wait=False, cancel_futures=True)

    def restart(self) -> None:
        """Forget what was counted; what comes next belongs to the next reading."""
        self._since, self._steps, self._samples, self._waited = time.monotonic(), 0, 0, 0.0

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Go around what waits for a batch."""
        asked = time.monotonic()
        yield
        came = time.monotonic()
        if self._end is None:
            self._waited += came - asked
        elif self._end.done():
            self._waited += max(0.0, came - max(asked, self._end.result()))

    def started(self, result: Array, samples: int) -> None:
        """Note a step whose computation has been handed to the devices, by one of its results."""
        self._end = self._watcher.submit(_end_of, result)
        self._steps += 1
        self._samples += samples

    def read(self) -> dict[str, float]:
        """Return what was counted since the last reading, and begin anew.

        Steps and samples (of all hosts) a second; the share of the time in which the devices waited for this
        host's data; and memory, in MB (1e6 bytes): see `peak_memory_mb`.
        """
        seconds = max(time.monotonic() - self._since, 1e-9)
        reading = {
            "steps_per_second": self._steps / seconds,
            "samples_per_second": self._samples / seconds,
            "data_wait_share": min(self._waited / seconds, 1.0),
            "peak_memory_mb": peak_memory_mb(),
        }
        self.restart()
        return reading


def peak_memory_mb() -> float:
    """Return the most memory that was taken at a time, in MB.

    It is that of this host's fullest device; where devices keep no count, as CPUs do not, of this process.
    """
    counts = [device.memory_stats() for device in jax.local_devices()]
    peaks = [count["peak_bytes_in_use"] for count in counts if count and "peak_bytes_in_use" in count]
    if peaks:
        return max(peaks) / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def _end_of(result: Array) -> float:
    jax.block_until_ready(result)
    return time.monotonic()
