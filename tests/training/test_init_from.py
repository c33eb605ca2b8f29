"""A fresh run may start from the weights of a finished model."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.training.checkpoints import Checkpoints
from poem_jax.training.loop import initial_state
from poem_jax.training.parallel import data_mesh
from poem_jax.weights.store import save


def start(config, path):
    config = replace(config, train=replace(config.train, init_from=str(path)))
    with Checkpoints(config.train.out, config) as checkpoints:
        return initial_state(config, checkpoints, data_mesh(jax.devices()[:1]))


def test_a_run_starts_from_a_saved_model(micro_config, micro_params, tmp_path):
    other = jax.tree.map(lambda leaf: leaf + 1 if leaf.dtype == np.float32 else leaf, micro_params)
    save(tmp_path / "model", micro_config.model, other)
    state = start(micro_config, tmp_path / "model")
    assert int(state.step) == 0
    jax.tree.map(np.testing.assert_array_equal, state.params["trainable"], other["trainable"])


def test_a_model_of_another_config_is_refused(micro_config, micro_params, tmp_path):
    save(tmp_path / "model", micro_config.model, micro_params)
    model = replace(micro_config.model, image_mean=0.25)
    with pytest.raises(ValueError, match="another config"):
        start(replace(micro_config, model=model), tmp_path / "model")
