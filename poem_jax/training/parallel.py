"""The train step on several devices, with the result of one: `shard_map`, `jit` over a mesh, or `pmap`."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from poem_jax.batch import MultiViewBatch
from poem_jax.training.config import DataParallel, TrainConfig
from poem_jax.training.state import TrainState
from poem_jax.training.step import Metrics, train_step
from poem_jax.typing import PyTree

AXIS = "data"
Step = Callable[[TrainState, MultiViewBatch, jax.Array], tuple[TrainState, Metrics]]


def data_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Lay all devices along one axis, over which batches are split."""
    devices = jax.devices() if devices is None else list(devices)
    return jax.make_mesh((len(devices),), (AXIS,), axis_types=(jax.sharding.AxisType.Auto,), devices=devices)


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding of what every device holds whole: state and keys."""
    return NamedSharding(mesh, P())


def split_batch(mesh: Mesh) -> NamedSharding:
    """Return the sharding of a batch: its first axis over the devices."""
    return NamedSharding(mesh, P(AXIS))


def check_batch_sizes(config: TrainConfig, mesh: Mesh) -> None:
    """Insist that every batch can be split evenly over the devices of this process.

    Raises:
        ValueError: it cannot, or there are several processes, or the model's samples depend on each other.
    """
    if jax.process_count() > 1:
        raise ValueError(
            f"training runs in one process on the devices of one machine; got {jax.process_count()} processes"
        )
    if config.model.couples_samples and mesh.size > 1:
        raise ValueError(
            f"a batch of this {type(config.model).__name__} must stay on one device, for its samples depend "
            f"on each other; got {mesh.size} devices. Show JAX one (CUDA_VISIBLE_DEVICES, "
            "`train.host_devices`)"
        )
    sizes = [shape.batch_size for shape in config.data.batches]
    if any(size % mesh.size for size in sizes):
        raise ValueError(
            f"every `batch_size` must be a multiple of the number of devices, {mesh.size}; got {sizes}. "
            "Change `data.batches`, or show JAX fewer devices (CUDA_VISIBLE_DEVICES, `train.host_devices`)"
        )


def put_batch(batch: MultiViewBatch, mesh: Mesh) -> MultiViewBatch:
    """Move a batch onto the devices, each its part."""
    return jax.device_put(batch, split_batch(mesh))


def compile_step(config: TrainConfig, mesh: Mesh, *, first_stage: bool = False) -> Step:
    """Return the jitted step for global arrays on `mesh`; its first argument is donated."""
    if config.train.data_parallel is DataParallel.JIT or mesh.size == 1:
        return jax.jit(
            partial(train_step, config=config, first_stage=first_stage),
            in_shardings=(replicated(mesh), split_batch(mesh), replicated(mesh)),
            out_shardings=replicated(mesh),
            donate_argnums=0,
        )
    sharded = jax.shard_map(
        partial(train_step, config=config, axis_name=AXIS, first_stage=first_stage),
        mesh=mesh,
        in_specs=(P(), P(AXIS), P()),
        out_specs=P(),
        # The step sums gradients itself, as it must under pmap; the check would insert those sums again.
        check_vma=False,
    )
    return jax.jit(sharded, donate_argnums=0)


def pmap_step(config: TrainConfig, devices: Sequence[Any]) -> Step:
    """Return the step under `jax.pmap`: every argument but the key has a leading device axis."""
    return jax.pmap(
        partial(train_step, config=config, axis_name=AXIS),
        axis_name=AXIS,
        in_axes=(0, 0, None),
        devices=list(devices),
        donate_argnums=0,
    )


def stack_for_devices(tree: PyTree, count: int) -> PyTree:
    """Split the first axis of every leaf into (device, the rest)."""
    return jax.tree.map(lambda x: x.reshape(count, x.shape[0] // count, *x.shape[1:]), tree)
