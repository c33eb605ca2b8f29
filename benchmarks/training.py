"""How fast is a training step? `python benchmarks/training.py [--preset NAME ...] [--rounds N]`.

One whole step (value, gradients, Adam) as `poem train` takes it on a CPU, on a batch of synthetic captures:
with kernels' gradients by minimal filtering (`poem_jax/models/winograd.py`), and with XLA's own everywhere.
Both programs run in one process by turns, with the allocator settings of the `poem` command and two host
devices; figures are medians. The first step of each, which compiles, does not count.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from unittest import mock

from poem_jax.io.allocator import SETTINGS

BATCHES = {"tiny": (16, 4), "v1": (2, 8)}
"""Samples and views a step: a quarter of the shipped model's batch, an eighth of POEM v1's (ResNet-34 at
256 px), which are as large as measures a step well."""


def main() -> None:
    """Print a row for each preset, or time one where `--job` is given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", action="append", choices=BATCHES, help="repeatable; without it both")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--job", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.job:
        print(json.dumps(_time(given.preset[0], given.rounds)))
        return
    print("| preset | samples x views | XLA's gradients, s | minimal filtering, s | ratio |")
    print("|---|---|---|---|---|")
    for name in given.preset or BATCHES:
        command = [sys.executable, __file__, "--job", "--preset", name, "--rounds", str(given.rounds)]
        flags = "--xla_force_host_platform_device_count=2"
        environment = {**os.environ, "GLIBC_TUNABLES": SETTINGS, "XLA_FLAGS": flags}
        done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        plain, filtered = json.loads(done.stdout.splitlines()[-1])
        samples, views = BATCHES[name]
        row = f"| `{name}` | {samples} x {views} | {plain:.2f} | {filtered:.2f} | {plain / filtered:.2f} |"
        print(row, flush=True)


def _time(name: str, rounds: int) -> tuple[float, float]:
    from poem_jax.models import layers

    with mock.patch.object(layers, "_filters_gradients", return_value=False):
        plain = _steps(name)
        plain()
    filtered = _steps(name)
    filtered()
    forms = (plain, filtered)
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        for form, times in zip(forms, seconds, strict=True):
            start = time.perf_counter()
            form()
            times.append(time.perf_counter() - start)
    return statistics.median(seconds[0]), statistics.median(seconds[1])


def _steps(name: str) -> Callable[[], None]:
    """Return what takes one more step of an experiment."""
    import jax

    from poem_jax.experiments import open_experiment
    from poem_jax.models.apply import init
    from poem_jax.training.config import BatchShape
    from poem_jax.training.parallel import compile_step, data_mesh, put_batch, replicated
    from poem_jax.training.source import synthetic_batches
    from poem_jax.training.state import create_state

    samples, views = BATCHES[name]
    config = open_experiment(f"{name}_synthetic")
    data = replace(config.data, batches=(BatchShape(num_views=views, batch_size=samples),))
    config, mesh, key = replace(config, data=data), data_mesh(), jax.random.key(0)
    batch = put_batch(synthetic_batches(config.data)(0), mesh)
    step = compile_step(config, mesh)
    state = jax.device_put(create_state(init(config.model, key=key), config), replicated(mesh))

    def go() -> None:
        nonlocal state
        state, _ = step(state, batch, key)
        jax.block_until_ready(state)

    return go


if __name__ == "__main__":
    main()
