"""The state that a sitting begins with, and what the log says of it."""

import logging

import jax

from poem_jax.models.apply import init
from poem_jax.training.checkpoints import Checkpoints
from poem_jax.training.config import TrainConfig, git_commit
from poem_jax.training.parallel import put_everywhere
from poem_jax.training.state import TrainState, create_state
from poem_jax.typing import Params
from poem_jax.weights.store import SHIPPED, load

log = logging.getLogger(__name__)


def initial_state(config: TrainConfig, checkpoints: Checkpoints, mesh: jax.sharding.Mesh) -> TrainState:
    """Return the state of the newest checkpoint, or a fresh one, on every device of the mesh."""
    state = create_state(_first_params(config), config)
    count = sum(leaf.size for leaf in jax.tree.leaves(state.params["trainable"]))
    state = put_everywhere(state, mesh)
    log.info("devices %s", [str(device) for device in mesh.devices.flat])
    log.info("%d trainable parameters", count)
    log.info("git commit %s", git_commit())
    log.info("config in %s", checkpoints.config_file)
    if checkpoints.latest_step is not None:
        state = checkpoints.restore(state)
        log.info("resumed at step %d from %s", int(state.step), checkpoints.run_dir)
    return state


def _first_params(config: TrainConfig) -> Params:
    if config.train.init_from is not None:
        folder = SHIPPED if config.train.init_from == "shipped" else config.train.init_from
        return load(folder, expected=config.model)[1]
    return init(config.model, key=jax.random.key(config.train.seed))
