"""Two processes that take turns: each answers questions, one at a time, and idles in between.

Questions and answers are lines of JSON. What a process prints beside its answers goes to the error output.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_PAUSE_S = 0.3
"""In which the threads of the process that was asked before go to sleep: they wait for work for a while."""


class Worker:
    """The asking side."""

    def __init__(self, command: list[str], settings: str | None, *, folder: Path | None = None) -> None:
        """Start `command` in a folder, with or without glibc `settings`."""
        environment = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
        if settings is not None:
            environment["GLIBC_TUNABLES"] = settings
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=folder
        )

    def ask(self, question: str, **arguments: Any) -> Any:
        """Return the answer.

        Raises:
            RuntimeError: the process has ended.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        time.sleep(_PAUSE_S)
        try:
            self._process.stdin.write(json.dumps([question, arguments]) + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            raise RuntimeError(f"{self._process.args} ended with {self._process.wait()}")
        return json.loads(answer)

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *error: object) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait()


def serve(answers: Mapping[str, Callable[..., Any]]) -> None:
    """Answer what is asked until nobody asks any more; the answering side."""
    out = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    for line in sys.stdin:
        question, arguments = json.loads(line)
        out.write(json.dumps(answers[question](**arguments)) + "\n")
        out.flush()


def peak_gb() -> float:
    """Return the peak of this process's memory so far; not `ru_maxrss`, which a child inherits."""
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e9
