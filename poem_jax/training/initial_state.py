"""The state that a sitting begins with, and what the log says of it."""

import logging
import os
import socket
from pathlib import Path

import jax

from poem_jax.models.apply import init
from poem_jax.training.checkpoints import Checkpoints
from poem_jax.training.config import TrainConfig, git_commit
from poem_jax.training.first_stage import with_first_stage
from poem_jax.training.hosts import check_same_everywhere, count_where
from poem_jax.training.parallel import put_everywhere
from poem_jax.training.query_start import with_smooth_queries
from poem_jax.training.state import TrainState, create_state
from poem_jax.typing import Params
from poem_jax.weights.store import SHIPPED, checksum_of_leaves, flatten, load

log = logging.getLogger(__name__)


def initial_state(config: TrainConfig, checkpoints: Checkpoints, mesh: jax.sharding.Mesh) -> TrainState:
    """Return the state of the newest checkpoint, or a fresh one, on every device of the mesh."""
    params = _first_params(config)
    if checkpoints.latest_step is None:
        check_same_everywhere("weights to start from", _digest(params))
    state = create_state(params, config)
    count = sum(leaf.size for leaf in jax.tree.leaves(state.params["trainable"]))
    state = put_everywhere(state, mesh)
    log.info("devices %s", [str(device) for device in mesh.devices.flat])
    _warn_of_idle_gpus()
    log.info("%d trainable parameters", count)
    log.info("git commit %s", git_commit())
    log.info("config in %s", checkpoints.config_file)
    if checkpoints.latest_step is not None:
        state = checkpoints.restore(state)
        log.info("resumed at step %d from %s", int(state.step), checkpoints.run_dir)
    return state


def _first_params(config: TrainConfig) -> Params:
    run = config.train
    if run.init_from is not None:
        return load(_folder(run.init_from), expected=config.model)[1]
    params = init(config.model, key=jax.random.key(run.seed))
    if run.smooth_queries:
        params = with_smooth_queries(params, config.model, run.seed)
    if run.first_stage_from is None:
        return params
    return with_first_stage(params, load(_folder(run.first_stage_from))[1], run.first_stage_from)


def _folder(name: str) -> str | Path:
    return SHIPPED if name == "shipped" else name


def _digest(params: Params) -> str:
    """Return what tells these weights from others; nothing where there is no other host to compare with."""
    if jax.process_count() == 1:
        return ""
    return checksum_of_leaves(flatten(params))


def _warn_of_idle_gpus() -> None:
    """Launchers give each process one GPU: a job of one process a machine leaves the others idle."""
    if jax.process_count() == 1 or jax.default_backend() != "gpu":
        return
    used = jax.local_device_count() * count_where(socket.gethostname())
    there = _visible_gpus()
    if used < there:
        log.warning(
            "%d of the %d GPUs of %s are used: JAX gives each process one where a launcher starts "
            "them. Start one task a GPU",
            used,
            there,
            socket.gethostname(),
        )


def _visible_gpus() -> int:
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    if shown is not None:
        return len([name for name in shown.split(",") if name.strip()])
    return len(list(Path("/dev").glob("nvidia[0-9]*")))
