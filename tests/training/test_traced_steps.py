"""What a step hands on, by tracing it alone: on an accelerator too, whose program no CPU compiles."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import pytest

from poem_jax.models.config import HRNetConfig
from poem_jax.models.network import describe
from poem_jax.training.config import ComputeConfig, Precision, Rematerialise
from poem_jax.training.state import create_state
from poem_jax.training.step import train_step
from tests.training.conftest import MICRO

HALF = ComputeConfig(precision=Precision.BFLOAT16)
LEAN = replace(HALF, rematerialise=Rematerialise.BOTH, accumulate=2)
HRNET = HRNetConfig(4, stem_channels=4, stem_blocks=2, modules=(1, 1, 1), blocks=2)


def kinds(tree):
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)


@pytest.mark.slow
@pytest.mark.parametrize("on", ["cpu", "gpu"])
def test_half_numbers_stay_inside_the_step(micro_config, micro_batch, monkeypatch, on):
    """Weights, averages, Adam's moments and the statistics of live batch norms come out as they went in, and
    metrics are in float32. On an accelerator: also through HRNet's blocks in loops, each computed again, and
    parts in a loop around them."""
    monkeypatch.setattr(jax, "default_backend", lambda: on)
    model, compute = (MICRO, HALF) if on == "cpu" else (replace(MICRO, backbone=HRNET), LEAN)
    config = replace(micro_config, model=model, compute=compute)
    state = jax.eval_shape(partial(create_state, config=config), describe(model))
    after, metrics = jax.eval_shape(partial(train_step, config=config), state, micro_batch, jax.random.key(0))
    assert state.params["statistics"]
    assert state.ema is not None
    assert kinds(after) == kinds(state)
    floating = [leaf.dtype for leaf in jax.tree.leaves(after) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert set(floating) == {jnp.dtype("float32")}
    assert set(kinds(metrics).values()) == {((), jnp.dtype("float32"))}
