"""How fast is a training step, and what memory does it take? `python benchmarks/training.py [--only ROW]`.

    gradients   kernels' gradients by minimal filtering (`poem_jax/models/winograd.py`), and XLA's own
    compute     the shipped recipe's step in half numbers, with insides computed again, in parts
    memory      of a `v2-base` step at 1 x 8 views, with insides kept and computed again
    data        share of the shipped recipe's time that waits for captures drawn beside it
    scaling     devices and processes with a fixed share each, against one device with all of it

One whole step (value, gradients, Adam) as `poem train` takes it on a CPU, on batches of synthetic captures,
in a process with the allocator settings of the `poem` command. What is compared runs by turns in one process;
figures are medians, and steps that compile do not count. `--thin` takes models of a few channels, to see that
all rows run. `--resident` runs the `memory` row's steps, too, for what the process really takes; those of
`v2-base` take minutes.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from poem_jax.io.allocator import SETTINGS

GRADIENTS = {"tiny": (16, 4), "v1": (2, 8)}
"""Samples and views a step: a quarter of the shipped model's batch, an eighth of POEM v1's (ResNet-34 at
256 px), which are as large as measures a step well."""
SHIPPED, SHIPPED_BATCH = "tiny_continued", (16, 4)
DEVICES, SAMPLES_EACH = (1, 2, 4, 8), 4
PROCESSES = 2
BUFFERS_ALONE = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
"""XLA assigns buffers before LLVM compiles: what is not run need not be optimised, for ten minutes."""


def main() -> None:
    """Print the tables that are asked for, or do one `--job`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", choices=ROWS, help="repeatable; without it all")
    parser.add_argument("--preset", action="append", choices=GRADIENTS, help="of `gradients`; else both")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--thin", action="store_true")
    parser.add_argument("--resident", action="store_true")
    parser.add_argument("--job", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.job:
        from training_jobs.jobs import JOBS

        name, options = given.job
        print(json.dumps(JOBS[name](**json.loads(options))))
        return
    for name in given.only or ROWS:
        ROWS[name](given)


def gradients(given: argparse.Namespace) -> None:
    """Compare two gradients of kernels."""
    print("| preset | samples x views | XLA's gradients, s | minimal filtering, s | ratio |")
    print("|---|---|---|---|---|")
    for preset in given.preset or GRADIENTS:
        samples, views = GRADIENTS[preset]
        batch = {"samples": samples, "views": views, "rounds": given.rounds, "thin": given.thin}
        plain, filtered = _do("time_gradients", 2, name=f"{preset}_synthetic", **batch)
        row = f"| `{preset}` | {samples} x {views} | {plain:.2f} | {filtered:.2f} | {plain / filtered:.2f} |"
        print(row, flush=True)


def compute(given: argparse.Namespace) -> None:
    """Compare ways to compute the shipped recipe's step."""
    samples, views = SHIPPED_BATCH
    forms = [
        "float32",
        "bfloat16",
        "float32, trunk again",
        "float32, decoder again",
        "float32, both again",
        "bfloat16, both again",
        "float32, 4 parts",
    ]
    found = _do(
        "time_compute",
        2,
        name=SHIPPED,
        samples=samples,
        views=views,
        rounds=given.rounds,
        thin=given.thin,
        forms=forms,
    )
    print(f"| `{SHIPPED}`, {samples} x {views} | samples/s | times float32 | first loss |")
    print("|---|---|---|---|")
    first = found[forms[0]][0]
    for form, (seconds, loss) in found.items():
        print(f"| {form} | {samples / seconds:.2f} | {first / seconds:.2f} | {loss:.5f} |", flush=True)


def memory(given: argparse.Namespace) -> None:
    """Compare what steps need. A CPU's compiler merges the two passes: there the program needs no less where
    less is kept."""
    real = " peak of the process, GB | step, s |" if given.resident else ""
    print(f"| `v2-base`, 1 x 8 | kept, GB | beside state and batch, GB | state and batch, GB |{real}")
    print("|---|---|---|---|" + 2 * "---|" * given.resident)
    options: dict[str, Any] = {"name": "v2_base_synthetic", "samples": 1, "views": 8}
    for form in (
        "float32",
        "float32, trunk again",
        "float32, both again",
        "bfloat16",
        "bfloat16, both again",
    ):
        options |= {"thin": given.thin, "form": form, "resident": given.resident}
        found = _result(_start("measure_memory", 1, options, "" if given.resident else BUFFERS_ALONE))
        real = f" {found['peak']:.2f} | {found['seconds']:.1f} |" if given.resident else ""
        needs = f"{found['kept']:.2f} | {found['temporary']:.2f} | {found['arguments']:.2f}"
        print(f"| {form} | {needs} |{real}", flush=True)


def data(given: argparse.Namespace) -> None:
    """Measure what waits for captures."""
    found = _do("measure_wait", 2, name=SHIPPED, steps=4 * given.rounds, thin=given.thin)
    print(f"| `{SHIPPED}`, its own batches | waiting for data, % | samples/s |\n|---|---|---|")
    print(f"| {4 * given.rounds} steps | {100 * found['share']:.1f} | {found['rate']:.2f} |", flush=True)


def scaling(given: argparse.Namespace) -> None:
    """Give every device the same share, and compare with one device that has all."""
    print("| devices | samples | step, s | one device, s | overhead, % | largest difference of a loss |")
    print("|---|---|---|---|---|---|")
    options = {"name": SHIPPED, "views": SHIPPED_BATCH[1], "rounds": given.rounds, "thin": given.thin}
    losses: dict[int, list[float]] = {}
    seconds: dict[int, float] = {}
    for count in DEVICES:
        samples = SAMPLES_EACH * count
        found = _do("time_scaling", count, **options, samples=samples, alone=True)
        (split, losses[count]), (taken, seconds[count]) = found["losses"], found["seconds"]
        _print_scaling(f"{count}", samples, taken, seconds[count], split, losses[count])
    samples = SAMPLES_EACH * PROCESSES
    found = _do_in_processes(**options, samples=samples)
    ours, taken = found["losses"][0], found["seconds"][0]
    _print_scaling(f"{PROCESSES} processes of 1", samples, taken, seconds[PROCESSES], ours, losses[PROCESSES])


def _print_scaling(
    what: str, samples: int, taken: float, alone: float, split: list[float], whole: list[float]
) -> None:
    apart = max(abs(a / b - 1) for a, b in zip(split, whole, strict=True))
    overhead = 100 * (taken / alone - 1)
    print(f"| {what} | {samples} | {taken:.2f} | {alone:.2f} | {overhead:.0f} | {apart:.1e} |", flush=True)


ROWS: dict[str, Callable[[argparse.Namespace], None]] = {
    row.__name__: row for row in (gradients, compute, memory, data, scaling)
}


def _do(job: str, devices: int, **options: Any) -> Any:
    """Do a job in a process of its own, and return what it found."""
    return _result(_start(job, devices, options))


def _do_in_processes(**options: Any) -> Any:
    """Do the scaling job in several processes of one device each."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        hosts = {"coordinator": f"localhost:{free.getsockname()[1]}", "count": PROCESSES}
    running = [
        _start("time_scaling_of_hosts", 1, {**options, **hosts, "index": index}) for index in range(PROCESSES)
    ]
    try:
        first, *_ = [_result(process) for process in running]
    finally:
        # One that failed leaves the others waiting for it.
        for process in running:
            with process:
                process.kill()
    return first


def _start(job: str, devices: int, options: dict[str, Any], flags: str = "") -> "subprocess.Popen[str]":
    flags = f"--xla_force_host_platform_device_count={devices} {flags}"
    environment = {**os.environ, "GLIBC_TUNABLES": SETTINGS, "XLA_FLAGS": flags}
    command = [sys.executable, __file__, "--job", job, json.dumps(options)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def _result(process: "subprocess.Popen[str]") -> Any:
    out, _ = process.communicate()
    if process.returncode:
        raise SystemExit(f"a job ended with status {process.returncode}; its own output says why")
    return json.loads(out.splitlines()[-1])


if __name__ == "__main__":
    main()
