"""Whole training steps to measure: an experiment's, on batches of its own synthetic captures."""

import contextlib
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax

from poem_jax.batch import MultiViewBatch
from poem_jax.experiments import open_experiment
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.models.apply import init
from poem_jax.models.config import Config, ResNetConfig
from poem_jax.models.network import describe, forward
from poem_jax.models.precision import cast_weights
from poem_jax.training.config import BatchShape, ComputeConfig, Precision, Rematerialise, TrainConfig
from poem_jax.training.parallel import compile_step, put_batch, put_everywhere
from poem_jax.training.state import TrainState, create_state
from poem_jax.training.step import RECOMPUTED
from poem_jax.typing import Array, Params

COMPUTE = {
    "float32": ComputeConfig(),
    "bfloat16": ComputeConfig(precision=Precision.BFLOAT16),
    "float32, trunk again": ComputeConfig(rematerialise=Rematerialise.TRUNK),
    "float32, decoder again": ComputeConfig(rematerialise=Rematerialise.DECODER),
    "float32, both again": ComputeConfig(rematerialise=Rematerialise.BOTH),
    "bfloat16, both again": ComputeConfig(precision=Precision.BFLOAT16, rematerialise=Rematerialise.BOTH),
    "float32, 4 parts": ComputeConfig(accumulate=4),
}
"""Ways to compute a step, by what a table calls them."""


def experiment(name: str, samples: int, views: int, *, thin: bool) -> TrainConfig:
    """Open an experiment with one kind of batch.

    Args:
        name: of the experiment.
        samples: of a batch, on all devices together.
        views: of every sample.
        thin: a model of a few channels and layers in its place, to see that a row runs.
    """
    config = open_experiment(name)
    model = _thin(config.model) if thin else config.model
    data = replace(
        config.data,
        batches=(BatchShape(num_views=views, batch_size=samples),),
        synthetic=replace(config.data.synthetic, image_hw=model.image_hw),
    )
    return replace(config, model=model, data=data, train=replace(config.train, host_devices=1))


def _thin(model: Any) -> Any:
    """Keep a model's design."""
    smaller: dict[str, Any] = {"image_hw": (64, 64), "width": 16}
    if isinstance(model.backbone, ResNetConfig):
        stages = len(model.backbone.blocks)
        smaller["backbone"] = replace(model.backbone, blocks=(1,) * stages, channels=(16,) * stages)
    else:
        few = {"width": 8, "stem_channels": 8, "stem_blocks": 2, "modules": (1, 1, 1), "blocks": 1}
        smaller["backbone"] = replace(model.backbone, **few)
    if isinstance(model, Config):
        smaller["decoder"] = replace(model.decoder, num_layers=1, num_heads=2)
        smaller["basis"] = replace(model.basis, num_points=256)
    return replace(model, **smaller)


def fresh_state(config: TrainConfig, mesh: jax.sharding.Mesh) -> TrainState:
    """Return fresh weights on every device."""
    return put_everywhere(create_state(init(config.model, key=jax.random.key(0)), config), mesh)


def stepper(
    config: TrainConfig, batch: MultiViewBatch, mesh: jax.sharding.Mesh
) -> Callable[[], dict[str, float]]:
    """Return what takes one more step, and gives its metrics."""
    state, key = fresh_state(config, mesh), put_everywhere(jax.random.key(0), mesh)
    step, given = compile_step(config, mesh), put_batch(batch, mesh)

    def go() -> dict[str, float]:
        nonlocal state
        state, metrics = step(state, given, key)
        jax.block_until_ready(state)
        return {name: float(value) for name, value in metrics.items()}

    return go


def kept_gb(config: TrainConfig, batch: MultiViewBatch) -> float:
    """Return what JAX carries from a step's forward pass to its backward one, in GB; nothing is computed."""
    model, compute = config.model, config.compute
    params = describe(model)
    root = batch.joints_world[:, ROOT_JOINT] if model.takes_root else None

    def backward(trainable: Params, fixed: Params, views: Array) -> Any:
        def found(trainable: Params) -> list[Array]:
            whole = {**fixed, "trainable": trainable}
            if compute.precision is Precision.BFLOAT16:
                whole = cast_weights(whole, model)
            options = {"config": model, "root_world": root, "train": True}
            rows = RECOMPUTED[compute.rematerialise]
            seen, _ = forward(whole, views, batch.cameras, recomputed=rows, **options)
            given = [seen.layers_world, seen.vertices_world, seen.keypoints_px, seen.heat_maps]
            return [leaf for leaf in given if leaf is not None]

        return jax.vjp(found, trainable)[1]

    kept = jax.eval_shape(backward, params["trainable"], params, batch.views)
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(kept)) / 1e9


def medians(forms: Sequence[Callable[[], Any]], rounds: int) -> list[float]:
    """Return each form's median seconds, taken by turns; the first call of each, which compiles, does not
    count."""
    for form in forms:
        form()
    seconds: list[list[float]] = [[] for _ in forms]
    for _ in range(rounds):
        for form, times in zip(forms, seconds, strict=True):
            start = time.perf_counter()
            form()
            times.append(time.perf_counter() - start)
    return [statistics.median(times) for times in seconds]


def forget_peak() -> None:
    """Let the peak count from now on, where the system can."""
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def peak_gb() -> float:
    """Return the peak of this process so far; not `ru_maxrss`, which a child inherits from its parent."""
    try:
        with open("/proc/self/status") as lines:
            return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e9
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
