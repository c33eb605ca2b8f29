"""`python -m tools.accelerator`: measure what a GPU gives, then train on, and keep to the time."""

import argparse
import importlib.metadata
import itertools
import shutil
import sys
from pathlib import Path

from poem_jax.cli.signals import exit_code, stop_on_signals
from tools.accelerator import parts, readme
from tools.accelerator.budget import Budget
from tools.accelerator.going_on import SAVING_S, ended_as_asked, figures_of, newest_step, train_on
from tools.accelerator.measurer import DoesNotFit, Measurer, RowFailed
from tools.accelerator.plan import PLANS, Plan
from tools.accelerator.results import Figures, Results

TRAINING_SHARE = 0.4
"""Of the time, kept for training; what the rows leave over goes there too."""
_LEAST_TRAINING_S = 15.0
"""Beside the time for saving: less would not reach its first step."""
_STARTING_S = 60.0
"""Of JAX and the driver, where they are slow."""
PARTS = "parts"
"""Folder below `--out` with the run, to carry away."""
_README = Path(__file__).parents[2] / "README.md"


def main(arguments: list[str] | None = None) -> int:
    """Do it; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.accelerator", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="all of it: starting, compiling, saving")
    parser.add_argument("--out", type=Path, default=Path("out/accelerator"), help="results and parts")
    parser.add_argument("--run", type=Path, help="the run that goes on; tiny_accelerator's")
    parser.add_argument("--device", choices=("gpu", "cpu"), default="gpu")
    parser.add_argument("--size", choices=tuple(PLANS), default="whole", help="micro: does it run?")
    parser.add_argument("--readme", type=Path, help="file whose table is rewritten; README.md for a GPU")
    given = parser.parse_args(arguments)
    plan = PLANS[given.size]()
    given.run = given.run or Path(plan.going_on.train.out)
    try:
        with stop_on_signals():
            return _run(given, plan, Budget(given.minutes))
    except KeyboardInterrupt as request:
        print(f"stopped; {given.out} has the rows so far, {given.run} the run. The same command goes on")
        return exit_code(request)
    except (ValueError, FileExistsError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _run(given: argparse.Namespace, plan: Plan, budget: Budget) -> int:
    results = Results(given.out)
    _take_the_newer(given.run, given.out / PARTS)
    on_cpu = given.device == "cpu"
    with Measurer(on_cpu=on_cpu) as measurer:
        results.use_machine(_machine(measurer, plan, budget, on_cpu=on_cpu))
        _measure(measurer, plan, results, budget, keep=60 * TRAINING_SHARE * given.minutes)
    table = readme.table(results)
    print(f"\n{table}\n", flush=True)
    target = given.readme or (_README if given.device == "gpu" and given.size == "whole" else None)
    if target is not None:
        readme.rewrite(target, table)
    return _go_on(given, results, budget, on_cpu=on_cpu)


def _machine(measurer: Measurer, plan: Plan, budget: Budget, *, on_cpu: bool) -> Figures:
    try:
        machine = measurer.measure(plan.machine, min(3 * _STARTING_S, budget.left()))
    except RowFailed as error:
        raise ValueError(f"the device cannot be used: {error}") from error
    if not on_cpu and machine["backend"] != "gpu":
        raise ValueError(_what_is_missing(machine))
    print(f"{machine['device']}, JAX {machine['jax']}", flush=True)
    return machine


def _measure(measurer: Measurer, plan: Plan, results: Results, budget: Budget, *, keep: float) -> None:
    """Measure the rows that have no figures yet, as long as there is time; after one that does not fit into
    memory at once what is smaller."""
    coming = list(reversed(plan.rows))
    while coming:
        row = coming.pop()
        if results.is_measured(row.name):
            print(f"{row.name}: measured before", flush=True)
            continue
        left = budget.left(keep=keep)
        if left < row.about_s:
            problem = f"skipped: it takes about {row.about_s:.0f} s, and {left:.0f} s are left for rows"
            results.note(row.name, {"problem": problem})
        else:
            try:
                limit = min(left, plan.patience * row.about_s + _STARTING_S)
                results.note(row.name, measurer.measure(row, limit))
            except RowFailed as error:
                results.note(row.name, {"problem": f"failed: {error}"})
                if isinstance(error, DoesNotFit) and row.smaller is not None:
                    coming.append(row.smaller)
        print(f"{row.name}: {_in_words(results.rows[row.name])}", flush=True)


def _go_on(given: argparse.Namespace, results: Results, budget: Budget, *, on_cpu: bool) -> int:
    """Train from where the run stands; pack what comes of it."""
    packed = given.out / PARTS
    if budget.left(keep=SAVING_S) < _LEAST_TRAINING_S:
        print("no time is left to train on")
        return 0
    try:
        code = train_on(given.run, given.size, budget, on_cpu=on_cpu)
    finally:
        step = newest_step(given.run)
        if step is not None:
            files = parts.pack(given.run, packed, step=step)
            results.going_on = figures_of(given.run)
            results.write()
            print(f"{len(files)} files in {packed}: the run, to go on with elsewhere", flush=True)
    if ended_as_asked(code):
        return 0
    print(f"error: the training ended with {code}; its words are above", file=sys.stderr)
    return 1


def _take_the_newer(run: Path, packed: Path) -> None:
    """Unpack the run that was carried here, unless the one that stands here is as far; nothing is removed.

    Raises: ValueError: a part is missing or damaged.
    """
    if not packed.exists():
        return
    carried, here = parts.step_of(packed), newest_step(run)
    if here is not None and here >= carried:
        return
    kept = None
    if run.exists():
        kept = next(p for n in itertools.count(1) if not (p := run.with_name(f"{run.name}.{n}")).exists())
        run.rename(kept)
    try:
        run.parent.mkdir(parents=True, exist_ok=True)
        parts.unpack(packed, run)
    except ValueError:
        if kept is not None:
            kept.rename(run)
        raise
    older = "" if kept is None else f"; the one that stood there, older, is now {kept}"
    print(f"the run of {packed}, at step {carried}, goes on in {run}{older}", flush=True)


def _what_is_missing(machine: Figures) -> str:
    """Say why there is no GPU, and what helps."""
    instead = "To see that the script runs: --device cpu --size micro"
    if shutil.which("nvidia-smi") is None:
        return f"no GPU here: JAX runs on {machine['device']}, and there is no NVIDIA driver. {instead}"
    version = importlib.metadata.version("jax")
    return (
        f"this machine has an NVIDIA driver, but JAX has no CUDA and runs on {machine['device']}. Do: "
        f"{sys.executable} -m pip install 'jax[cuda13]=={version}' (drivers before 580: cuda12). {instead}"
    )


def _in_words(figures: Figures) -> str:
    if "problem" in figures:
        return figures["problem"]
    shown = {key: value for key, value in figures.items() if isinstance(value, float)}
    return ", ".join(f"{key} {value:.4g}" for key, value in shown.items())


if __name__ == "__main__":
    sys.exit(main())
