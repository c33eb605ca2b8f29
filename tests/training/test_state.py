"""Optimiser, schedule, clipping, and the moving average."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.training.config import Clip, OptimizerConfig, Schedule
from poem_jax.training.state import (
    clip_each_tensor,
    create_state,
    evaluation_params,
    learning_rate,
    make_optimizer,
    update_average,
)


def with_optimizer(config, steps=100, **options):
    return replace(config, optimizer=OptimizerConfig(**options), train=replace(config.train, steps=steps))


def test_cosine_with_warm_up(micro_config):
    config = with_optimizer(micro_config, learning_rate=1.0, warmup_steps=10, final_ratio=0.1)
    rate = learning_rate(config)
    np.testing.assert_allclose([rate(0), rate(5), rate(10)], [0.1, 0.55, 1.0], rtol=1e-6)
    np.testing.assert_allclose(rate(55), 0.1 + 0.9 / 2, rtol=1e-6)
    np.testing.assert_allclose([rate(100), rate(500)], 0.1, rtol=1e-5)


def test_step_schedule_and_constant(micro_config):
    rate = learning_rate(with_optimizer(micro_config, learning_rate=1.0, schedule=Schedule.STEP))
    np.testing.assert_allclose([rate(69), rate(70), rate(71)], [1.0, 0.1, 0.1], rtol=1e-6)
    rate = learning_rate(with_optimizer(micro_config, learning_rate=0.5, schedule=Schedule.CONSTANT))
    assert rate(10**6) == 0.5


def test_each_tensor_is_clipped_on_its_own():
    gradients = {"large": jnp.array([3.0, 4.0]), "small": jnp.array([0.3, 0.4])}
    clipped, _ = clip_each_tensor(1.0).update(gradients, clip_each_tensor(1.0).init(gradients))
    np.testing.assert_allclose(clipped["large"], [0.6, 0.8], rtol=1e-5)
    np.testing.assert_array_equal(clipped["small"], gradients["small"])


def test_stacked_blocks_are_clipped_one_by_one():
    """HRNet keeps equal blocks in one array, (module, block, ...), that the release has as many tensors."""
    kernel = jnp.ones((2, 3, 4)) * jnp.array([0.1, 2.0, 0.2])[:, None]
    nested = {"stage2": {"blocks": {"branches": {"0": {"blocks": {"kernel": kernel}}}}}}
    clipped, _ = clip_each_tensor(1.0).update(nested, clip_each_tensor(1.0).init(nested))
    found = clipped["stage2"]["blocks"]["branches"]["0"]["blocks"]["kernel"]
    expected = kernel / jnp.maximum(jnp.linalg.norm(kernel, axis=-1, keepdims=True), 1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    listed = {"stages": {"0": {"blocks": {"1": {"kernel": kernel}}}}}
    clipped, _ = clip_each_tensor(1.0).update(listed, clip_each_tensor(1.0).init(listed))
    assert jnp.linalg.norm(clipped["stages"]["0"]["blocks"]["1"]["kernel"]) == pytest.approx(1, rel=1e-5)


@pytest.mark.parametrize("clip", list(Clip))
def test_first_adam_step_has_the_learning_rate(micro_config, clip):
    config = with_optimizer(micro_config, clip=clip, schedule=Schedule.CONSTANT, learning_rate=0.25)
    optimizer, params = make_optimizer(config), {"w": jnp.zeros(2)}
    updates, _ = optimizer.update({"w": jnp.array([7.0, -9.0])}, optimizer.init(params), params)
    np.testing.assert_allclose(updates["w"], [-0.25, 0.25], rtol=1e-5)


def test_weight_decay_spares_biases(micro_config):
    config = with_optimizer(micro_config, weight_decay=0.1, learning_rate=1.0, schedule=Schedule.CONSTANT)
    optimizer, params = make_optimizer(config), {"w": jnp.ones((2, 2)), "b": jnp.ones(2)}
    updates, _ = optimizer.update(jax.tree.map(jnp.zeros_like, params), optimizer.init(params), params)
    np.testing.assert_allclose(updates["w"], -0.1, rtol=1e-6)
    np.testing.assert_array_equal(updates["b"], 0)


def test_average_follows_and_young_averages_hurry():
    one, zero = ({"trainable": {"w": jnp.full(1, x)}, "statistics": {}} for x in (1.0, 0.0))
    young = update_average(zero, one, jnp.array(0), 0.999)
    old = update_average(zero, one, jnp.array(10**6), 0.999)
    np.testing.assert_allclose(young["trainable"]["w"], 0.9, rtol=1e-6)
    np.testing.assert_allclose(old["trainable"]["w"], 0.001, rtol=1e-3)


def test_evaluation_takes_the_average_where_there_is_one(micro_params, micro_config):
    state = create_state(micro_params, micro_config)
    moved = state._replace(ema=jax.tree.map(lambda x: x + 1, state.ema))
    embeddings = evaluation_params(moved)["trainable"]["decoder"]["embeddings"]
    np.testing.assert_allclose(embeddings, state.params["trainable"]["decoder"]["embeddings"] + 1)
    assert evaluation_params(moved)["constants"] is state.params["constants"]
    plain = create_state(micro_params, with_optimizer(micro_config))
    assert plain.ema is None
    assert evaluation_params(plain) is plain.params
