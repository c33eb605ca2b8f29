"""Training on, in a process of its own: `python -m tools.accelerator.going_on RUN SIZE MINUTES`.

It ends after so many minutes or at SIGTERM, with a checkpoint either way, as every run does.
"""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from poem_jax.cli.messages import set_up_logging
from poem_jax.cli.signals import STOPPED, exit_code, stop_on_signals
from poem_jax.training.config import TrainConfig
from poem_jax.training.journal import METRICS, read_entries
from tools.accelerator.budget import Budget
from tools.accelerator.results import Figures

_LAST_WORDS_S = 60.0
"""For the step under way, a program that may still be compiled for it, and its checkpoint when the time is
up; then the process is killed, and the checkpoint before stands."""
FIRST_CHECKPOINT = 20
"""Steps between the checkpoints of a first sitting: one that must be killed, since a program is compiled too
long, shall leave a run, and lose little of it."""
_PATIENCE_S = 300.0
"""For the same after a signal, which sets no time."""
SAVING_S = _LAST_WORDS_S + 10.0
"""Kept for that and for packing the run."""


def train_on(run: Path, size: str, budget: Budget, *, on_cpu: bool) -> int:
    """Train in the folder `run` for what is left, and wait for the end; return the exit code.

    A signal to this process is passed on, and the checkpoint waited for.
    """
    minutes = budget.left(keep=SAVING_S) / 60
    command = [sys.executable, "-m", "tools.accelerator.going_on", str(run), size, f"{minutes:.3f}"]
    environment = dict(os.environ, JAX_PLATFORMS="cpu") if on_cpu else dict(os.environ)
    # Ctrl-C is this process's: the other one would take the signal passed on for a second.
    process = subprocess.Popen(command, env=environment, start_new_session=True)
    try:
        # Starting and compiling take their share before the run's own clock begins.
        return process.wait(budget.left(keep=SAVING_S))
    except subprocess.TimeoutExpired:
        return stop(process, _LAST_WORDS_S)
    except KeyboardInterrupt:
        stop(process, _PATIENCE_S)
        raise


def stop(process: "subprocess.Popen[bytes]", seconds: float) -> int:
    """Ask a process to end, once, for a second signal would end it at once; kill it after so long."""
    process.send_signal(signal.SIGTERM)
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def ended_as_asked(code: int) -> bool:
    """Say whether an exit code is that of a training at its end, or of one that was told to stop; before it
    listens, the signal itself ends it."""
    return code in (0, STOPPED + signal.SIGTERM, -signal.SIGTERM)


def figures_of(run: Path) -> Figures:
    """Return what the journal of a run says last of its pace, its loss and its validation."""
    found: Figures = {}
    for entry in read_entries(run / METRICS):
        found[entry["group"]] = {key: value for key, value in entry.items() if key != "group"}
    return found


def newest_step(run: Path) -> int | None:
    """Return the step of a run's newest checkpoint; None = it has none."""
    names = (folder.name for folder in (run / "checkpoints").glob("*"))
    return max((int(name) for name in names if name.isdigit()), default=None)


def sitting_of(config: TrainConfig, run: Path, minutes: float) -> TrainConfig:
    """Return the experiment as it is trained in a folder for so long; a fresh run is soon on disk."""
    every = config.train.checkpoint_every
    if newest_step(run) is None:
        every = min(every, FIRST_CHECKPOINT)
    options = replace(
        config.train, out=str(run), max_minutes=max(minutes, 0.01), checkpoint_every=every, progress=False
    )
    return replace(config, train=options)


def _train(config: TrainConfig, processes: int) -> None:
    from poem_jax.training.loop import train
    from tools.accelerator.captures import drawn_by_processes

    with drawn_by_processes(config.data, processes) as batch_at:
        train(config, batch_at=batch_at, command="make accelerator")


def main(arguments: list[str]) -> int:
    """Train the plan of a size."""
    from poem_jax.io.compilation_cache import use_compilation_cache
    from tools.accelerator.plan import PLANS

    run, size, minutes = arguments
    set_up_logging()
    use_compilation_cache()
    config = sitting_of(PLANS[size]().going_on, Path(run), float(minutes))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        with stop_on_signals():
            _train(config, processes=max(cores - 1, 1))
    except KeyboardInterrupt as request:
        return exit_code(request)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
