"""The jobs: what they are given comes from a command line as JSON, what they find goes back as JSON."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest import mock

import jax

from poem_jax.data.loader import draw_ahead
from poem_jax.experiments import open_experiment
from poem_jax.models import layers
from poem_jax.training.hosts import start_hosts
from poem_jax.training.parallel import compile_step, data_mesh, put_batch
from poem_jax.training.source import drawing_threads, synthetic_batches
from training_jobs.steps import (
    COMPUTE,
    experiment,
    forget_peak,
    fresh_state,
    kept_gb,
    medians,
    peak_gb,
    stepper,
)


def time_gradients(name: str, samples: int, views: int, rounds: int, thin: bool) -> list[float]:
    """Return the seconds of a step with XLA's own gradients of kernels, and by minimal filtering."""
    config, mesh = experiment(name, samples, views, thin=thin), data_mesh()
    batch = synthetic_batches(config.data)(0)
    with mock.patch.object(layers, "_filters_gradients", return_value=False):
        plain = stepper(config, batch, mesh)
        plain()
    return medians([plain, stepper(config, batch, mesh)], rounds)


def time_compute(
    name: str, samples: int, views: int, rounds: int, thin: bool, forms: list[str]
) -> dict[str, list[float]]:
    """Return the seconds of a step and its first loss, by the way it is computed."""
    config, mesh = experiment(name, samples, views, thin=thin), data_mesh()
    batch = synthetic_batches(config.data)(0)
    steps = [stepper(replace(config, compute=COMPUTE[form]), batch, mesh) for form in forms]
    losses = [step()["loss"] for step in steps]
    return {
        form: [seconds, loss]
        for form, seconds, loss in zip(forms, medians(steps, rounds), losses, strict=True)
    }


def measure_memory(
    name: str, samples: int, views: int, thin: bool, form: str, resident: bool
) -> dict[str, float]:
    """Return what a step keeps for its backward pass, and what its program needs beside state and batch by
    the compiler's own account, in GB.

    `resident`: also take the step, for the peak of this process after compiling and the second one's seconds.
    """
    config = replace(experiment(name, samples, views, thin=thin), compute=COMPUTE[form])
    mesh = data_mesh()
    drawn = synthetic_batches(config.data)(0)
    batch, state = put_batch(drawn, mesh), fresh_state(config, mesh)
    key = jax.random.key(0)
    program = compile_step(config, mesh).lower(state, batch, key).compile()  # pyright: ignore[reportFunctionMemberAccess]
    needed = program.memory_analysis()
    found = {
        "kept": kept_gb(config, drawn),
        "temporary": needed.temp_size_in_bytes / 1e9,
        "arguments": needed.argument_size_in_bytes / 1e9,
    }
    if resident:
        forget_peak()
        state, _ = program(state, batch, key)
        jax.block_until_ready(state)
        start = time.perf_counter()
        jax.block_until_ready(program(state, batch, key))
        found |= {"seconds": time.perf_counter() - start, "peak": peak_gb()}
    return found


def measure_wait(name: str, steps: int, thin: bool) -> dict[str, float]:
    """Return which share of the time the loop waits for batches that are drawn beside it, and samples a
    second; steps that compile do not count."""
    config = open_experiment(name)
    if thin:
        small = experiment(name, 8, 4, thin=True)
        config = replace(small, data=replace(small.data, prefetch=config.data.prefetch))
    mesh, key = data_mesh(), jax.random.key(0)
    step, state = compile_step(config, mesh), fresh_state(config, mesh)
    batches = draw_ahead(
        synthetic_batches(config.data), 0, ahead=config.data.prefetch, workers=drawing_threads(config.data)
    )
    coming = {(kind.batch_size, kind.num_views) for kind in config.data.batches if kind.weight}
    seen: set[tuple[int, ...]] = set()
    waited = busy = 0.0
    samples = counted = 0
    while counted < steps:
        start = time.perf_counter()
        batch = next(batches)
        drawn = time.perf_counter()
        state, metrics = step(state, put_batch(batch, mesh), key)
        jax.block_until_ready(metrics)
        if seen == coming:
            waited += drawn - start
            busy += time.perf_counter() - start
            samples, counted = samples + len(batch.views), counted + 1
        seen.add(batch.views.shape[:2])
    batches.close()
    return {"share": waited / busy, "rate": samples / busy}


def time_scaling(name: str, samples: int, views: int, rounds: int, thin: bool, alone: bool) -> dict[str, Any]:
    """Return the losses of three steps and the median seconds of a step, `samples` in all; on all devices,
    and if `alone` on one of them, too, by turns."""
    config, mesh = experiment(name, samples, views, thin=thin), data_mesh()
    host, hosts = jax.process_index(), jax.process_count()
    batch = synthetic_batches(config.data, host=host, hosts=hosts)(0)
    forms = [stepper(config, batch, mesh)]
    if alone:
        forms.append(stepper(config, batch, data_mesh(jax.devices()[:1])))
    losses = [[form()["loss"] for _ in range(3)] for form in forms]
    return {"losses": losses, "seconds": medians(forms, rounds)}


def time_scaling_of_hosts(coordinator: str, count: int, index: int, **rest: Any) -> dict[str, Any]:
    """Do the same as one of several processes."""
    start_hosts(coordinator, count, index)
    return time_scaling(**rest, alone=False)


JOBS: dict[str, Callable[..., Any]] = {
    job.__name__: job
    for job in (
        time_gradients,
        time_compute,
        measure_memory,
        measure_wait,
        time_scaling,
        time_scaling_of_hosts,
    )
}
