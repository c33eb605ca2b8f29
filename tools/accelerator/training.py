"""Time and memory of a training step, for `rows.Training`."""

import time
from dataclasses import replace

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.training.config import BatchShape, TrainConfig
from tools.accelerator.results import Figures
from tools.accelerator.timing import time_calls

_DRAWN = 8
"""Samples that are drawn; larger batches hold each several times, which costs a step the same."""


def measure_training(config: TrainConfig, batch_size: int) -> Figures:
    """Time whole steps on one device, the batch lying there; of the config's kinds of batches the first.

    Returns: `samples_per_second`, `tflops` (products and convolutions of the step as a whole, nothing that is
    computed twice), `temporary_gib` (XLA's plan) and what `Taken.figures` has.
    """
    import jax

    from poem_jax.models.apply import init
    from poem_jax.training.parallel import compile_step, data_mesh, put_batch, replicated
    from poem_jax.training.state import create_state
    from tools.accelerator.flops import count_flops

    shape = replace(config.data.batches[0], batch_size=batch_size)
    config = replace(config, data=replace(config.data, batches=(shape,)))
    mesh = data_mesh(jax.devices()[:1])
    batch = put_batch(_batch(config, shape), mesh)
    key = jax.device_put(jax.random.key(0), replicated(mesh))
    state = jax.device_put(create_state(init(config.model, key=key), config), replicated(mesh))
    step = compile_step(config, mesh)
    flops = count_flops(step, state, batch, key)
    start = time.perf_counter()
    compiled = step.lower(state, batch, key).compile()  # pyright: ignore[reportFunctionMemberAccess]
    compile_s, memory = time.perf_counter() - start, compiled.memory_analysis()

    def go() -> jax.Array:
        nonlocal state
        state, metrics = compiled(state, batch, key)
        return metrics["loss"]

    taken = time_calls(go)
    return {
        "views": shape.num_views,
        "samples_per_second": batch_size / taken.median_s,
        "tflops": 1e-12 * flops / taken.median_s,
        "compile_s": compile_s,
        "temporary_gib": None if memory is None else memory.temp_size_in_bytes / 2**30,
        **taken.figures(),
    }


def _batch(config: TrainConfig, shape: BatchShape) -> MultiViewBatch:
    """Draw a few samples and fill a batch with them."""
    import jax

    from poem_jax.training.source import synthetic_batches

    few = replace(shape, batch_size=min(shape.batch_size, _DRAWN))
    drawn = synthetic_batches(replace(config.data, batches=(few,)))(0)
    rows = np.arange(shape.batch_size) % few.batch_size
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], drawn)
