"""Rows measured in a process of their own, with a limit of time: one that dies or hangs ends alone."""

import os
import signal
import subprocess
import sys
import threading
from types import TracebackType

from poem_jax.mixture.wire import UNREADABLE, Failure, receive, send
from tools.accelerator.results import Figures
from tools.accelerator.rows import Row

_MEMORY = ("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.92")
"""The share of a GPU's memory that JAX takes: by default it leaves a quarter."""
_PATIENCE_S = 10.0


class RowFailed(RuntimeError):
    """A row has no figures; the message says why."""


class DoesNotFit(RowFailed):
    """The device's memory does not suffice for a row."""


class Measurer:
    """The process that measures, started when the first row comes and again after one that ended it."""

    def __init__(self, *, on_cpu: bool) -> None:
        self._environment = {_MEMORY[0]: _MEMORY[1], **os.environ}
        self._environment["PYTHONPATH"] = os.pathsep.join(path or os.getcwd() for path in sys.path)
        if on_cpu:
            self._environment["JAX_PLATFORMS"] = "cpu"
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Measurer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def measure(self, row: Row, limit_s: float) -> Figures:
        """Return a row's figures.

        Raises:
            DoesNotFit: memory did not suffice.
            RowFailed: anything else went wrong, the process died, or the limit came.
        """
        process = self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        too_late = threading.Event()

        def end() -> None:
            too_late.set()
            process.kill()

        limit = threading.Timer(limit_s, end)
        limit.start()
        try:
            send(process.stdin, row)
            reply = receive(process.stdout)
        except (EOFError, OSError, *UNREADABLE) as error:
            self.close()
            if too_late.is_set():
                raise RowFailed(f"not finished in {limit_s:.0f} s") from error
            raise RowFailed(f"its process ended {_how(process.returncode)}; its words are above") from error
        finally:
            limit.cancel()
        if isinstance(reply, Failure):
            kind = DoesNotFit if isinstance(reply.error, MemoryError) else RowFailed
            raise kind(str(reply.error))
        return reply

    def close(self) -> None:
        """End the process, so that the device is free."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.close()
            process.wait(_PATIENCE_S)
        except (BrokenPipeError, subprocess.TimeoutExpired):
            process.kill()
            process.wait()
        process.stdout.close()

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tools.accelerator.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=self._environment,
            )
        return self._process


def _how(code: int) -> str:
    return f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
