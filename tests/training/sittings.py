"""Sittings of `poem train` that start in no time: forked from a process that has imported everything.

A sitting that starts as users start it imports for five seconds, then traces its step for ten. The process
that forks (`python -m tests.training.sittings`) has no thread and has not used JAX, so that what it forks is
as good as fresh; it runs one sitting at a time. The first sitting leaves its traced step to those after it.
"""

import json
import logging
import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

_ENVIRONMENT = {
    # Libraries that start threads when they are imported: a fork would lose them.
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false",
}
_FILE_OPERATIONS = frozenset({"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.listdir"})


@dataclass(frozen=True)
class Blow:
    """When a sitting is killed (SIGKILL): at, or some time after, the n-th time it touches certain files."""

    name: str
    """Part of the files' paths."""
    number: int
    """From 1."""
    seconds: float = 0.0

    def await_it(self) -> None:
        """Let it happen to this process."""
        count = 0

        def watch(event: str, arguments: tuple) -> None:
            nonlocal count
            if event not in _FILE_OPERATIONS or self.name not in str(arguments[0]):
                return
            count += 1
            if count == self.number and self.seconds == 0:
                _kill_self()
            elif count == self.number:
                threading.Timer(self.seconds, _kill_self).start()

        sys.addaudithook(watch)


class Sittings:
    """Runs sittings, one after the other; use it as a context manager."""

    def __init__(self, logs: Path) -> None:
        """Start the process that forks.

        Args:
            logs: folder for what each sitting says, a file each.
        """
        self._logs, self._count = logs, 0
        # In the environment of all processes that come of it.
        self._mark = {"POEM_SITTINGS": str(logs)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.training.sittings"],
            cwd=Path(__file__).resolve().parents[2],
            env={**os.environ, **_ENVIRONMENT, **self._mark},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> "Sittings":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()

    def run(
        self, *arguments: str, blow: Blow | None = None, largest_file: int | None = None
    ) -> tuple[int, str]:
        """Run `poem train` to its end.

        Args:
            arguments: of `poem train`.
            blow: what kills it.
            largest_file: bytes that a file may have, as if the disk were full then.

        Returns:
            The exit status, that of a signal negative, and what it said.
        """
        self._count += 1
        log = self._logs / f"sitting_{self._count:02d}.log"
        order = {
            "arguments": arguments,
            "log": str(log),
            "program": str(self._logs / "step.pickle"),
            "blow": blow and asdict(blow),
            "largest_file": largest_file,
        }
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline()), log.read_text()

    def left_behind(self) -> list[int]:
        """Return the processes that a sitting has left; while one runs, its own."""
        ((name, value),) = self._mark.items()
        mark = f"{name}={value}".encode()
        numbers = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]
        return [pid for pid in numbers if pid != self._process.pid and mark in _environment(pid)]


def _environment(pid: int) -> list[bytes]:
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        # It has ended, or is not ours.
        return []


def _serve() -> None:
    import grain  # noqa: F401
    from orbax.checkpoint import v1  # noqa: F401

    import poem_jax.cli.run
    import poem_jax.models.poem_v2
    import poem_jax.synthetic.dataset
    import poem_jax.training.loop  # noqa: F401

    assert len(os.listdir("/proc/self/task")) == 1, "a process with threads must not fork"
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            _sit(**json.loads(line))
        _, status = os.waitpid(pid, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _sit(arguments: list[str], log: str, program: str, blow: dict | None, largest_file: int | None) -> None:
    """Be a sitting; this never returns."""
    from poem_jax.cli.run import main

    said = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for number in (1, 2):
        os.dup2(said, number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    _trace_once(Path(program))
    if largest_file is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
    if blow is not None:
        Blow(**blow).await_it()
    # What was imported has set up logging, which a command does itself.
    logging.getLogger().handlers.clear()
    sys.argv = ["poem", "train", *arguments]
    sys.exit(main(sys.argv[1:]))


def _trace_once(program: Path) -> None:
    """Let the loop's whole step be what this file holds, or write it."""
    import jax

    from poem_jax.training import loop

    def compile_step(
        config: Any, mesh: Any, *, first_stage: bool = False, make: Any = loop.compile_step
    ) -> Any:
        names = program.with_suffix(".json")

        def step(state: Any, batch: Any, key: jax.Array) -> Any:
            leaves, tree = jax.tree.flatten((state, batch, jax.random.key_data(key)))
            if not program.exists():
                whole_step = make(config, mesh, first_stage=first_stage)

                def of_leaves(*leaves: Any) -> list[Any]:
                    state, batch, key = tree.unflatten(leaves)
                    state, metrics = whole_step(state, batch, jax.random.wrap_key_data(key))
                    names.write_text(json.dumps(sorted(metrics)))
                    return jax.tree.leaves((state, metrics))

                exported = jax.export.export(jax.jit(of_leaves))(*leaves)
                # Its own `serialize` needs one more package; only the way to its gradient cannot be pickled.
                program.write_bytes(pickle.dumps(replace(exported, _get_vjp=None)))
            if not calls:
                calls.append(jax.jit(pickle.loads(program.read_bytes()).call))
            found, count = calls[0](*leaves), len(jax.tree.leaves(state))
            metrics = dict(zip(json.loads(names.read_text()), found[count:], strict=True))
            return jax.tree.structure(state).unflatten(found[:count]), metrics

        calls: list[Any] = []
        return step

    loop.compile_step = compile_step


def _kill_self() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    _serve()
