"""The train step on several devices, with the result of one: `shard_map`, `jit` over a mesh, or `pmap`.

The devices may belong to several hosts. Each host then gives its rows of a batch, and all devices together
hold the batch that a single host would have drawn, in the same order.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
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
    """Lay all devices along one axis, over which batches are split, those of a host beside each other."""
    devices = jax.devices() if devices is None else list(devices)
    auto = (jax.sharding.AxisType.Auto,)
    if jax.process_count() == 1:
        return jax.make_mesh((len(devices),), (AXIS,), axis_types=auto, devices=devices)
    # `make_mesh` may follow the wires of a TPU instead, and mix the hosts' rows.
    in_order = sorted(devices, key=lambda device: (device.process_index, device.id))
    return Mesh(np.array(in_order), (AXIS,), axis_types=auto)


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding of what every device holds whole: state and keys."""
    return NamedSharding(mesh, P())


def split_batch(mesh: Mesh) -> NamedSharding:
    """Return the sharding of a batch: its first axis over the devices."""
    return NamedSharding(mesh, P(AXIS))


def check_batch_sizes(config: TrainConfig, mesh: Mesh) -> None:
    """Insist that every batch can be split evenly over the devices of all hosts, and on each of them into
    the parts that it takes one after the other.

    Raises:
        ValueError: it cannot, or hosts have different numbers of devices, or the model's samples depend on
            each other.
    """
    if config.model.couples_samples and mesh.size > 1:
        raise ValueError(
            f"a batch of this {type(config.model).__name__} must stay on one device, for its samples depend "
            f"on each other; got {mesh.size} devices. Show JAX one (CUDA_VISIBLE_DEVICES, "
            "`train.host_devices`)"
        )
    of_hosts = Counter(device.process_index for device in mesh.devices.flat)
    if len(set(of_hosts.values())) > 1:
        counts = [number for _, number in sorted(of_hosts.items())]
        raise ValueError(
            f"every host must have the same number of devices; got {counts}. "
            "Show JAX fewer on some (CUDA_VISIBLE_DEVICES, `train.host_devices`), or leave a host out"
        )
    sizes = [shape.batch_size for shape in config.data.batches]
    parts = config.compute.accumulate
    if any(size % (mesh.size * parts) for size in sizes):
        hosts = f" of all {len(of_hosts)} hosts" if len(of_hosts) > 1 else ""
        times = f", times `compute.accumulate` = {parts}, {mesh.size * parts}" if parts > 1 else ""
        raise ValueError(
            f"every `batch_size` must be a multiple of the number of devices{hosts}, {mesh.size}{times}; "
            f"got {sizes}. "
            "Change `data.batches`, or show JAX fewer devices (CUDA_VISIBLE_DEVICES, `train.host_devices`)"
        )


def put_batch(batch: MultiViewBatch, mesh: Mesh) -> MultiViewBatch:
    """Move a batch, or this host's rows of it, onto the devices, each its part."""
    sharding = split_batch(mesh)
    if jax.process_count() == 1:
        return jax.device_put(batch, sharding)
    return jax.tree.map(lambda rows: jax.make_array_from_process_local_data(sharding, rows), batch)


def put_everywhere(tree: PyTree, mesh: Mesh) -> PyTree:
    """Put what every host has alike, such as a fresh state or a key, on every device."""
    if jax.process_count() == 1:
        return jax.device_put(tree, replicated(mesh))
    return jax.jit(lambda same: same, out_shardings=replicated(mesh))(tree)


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
