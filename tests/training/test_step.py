"""The pure step: it learns, it ignores padding, and any split over devices gives the same result."""

import functools
import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import poem_jax
from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.losses import match_keypoints
from poem_jax.models import layers
from poem_jax.training.config import (
    RELEASE_ROOT,
    ComputeConfig,
    DataParallel,
    OptimizerConfig,
    Rematerialise,
    RootSource,
    RunConfig,
    Schedule,
    TrainingRoot,
)
from poem_jax.training.parallel import (
    compile_step,
    data_mesh,
    pmap_step,
    put_batch,
    replicated,
    stack_for_devices,
)
from poem_jax.training.state import create_state, restart_moments
from poem_jax.training.step import existing_views, near_the_hand, noisy_root, train_step

KEY = jax.random.key(3)
TOLERANCE = {"rtol": 1e-4, "atol": 1e-6}
"""Sums run in another order when the batch is split."""


@functools.cache
def one_device(config):
    return jax.jit(partial(train_step, config=config))


@pytest.fixture
def config(micro_config):
    """Equal in all tests, so that they share one compiled step.

    Adam's large epsilon keeps its normalisation from blowing up the rounding of tiny gradients: an error d
    of a gradient moves a weight by at most learning rate x d / epsilon = d.
    """
    return replace(
        micro_config,
        train=replace(micro_config.train, out="unused"),
        optimizer=replace(micro_config.optimizer, learning_rate=1e-3, eps=1e-3),
    )


def compare(one, other):
    """Compare gradients (Adam's first moments), the weights they moved, statistics, and both averages."""

    def parts(state):
        return first_moments(state), state.params["trainable"], state.params["statistics"], state.ema

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **TOLERANCE), parts(one), parts(other))


def first_moments(state):
    return optax.tree.get(state.opt_state, "mu")


def uneven(batch):
    """Give the shards different numbers of valid views and samples."""
    mask = np.array(batch.cameras.view_mask)
    mask[1, 2] = mask[2, 0] = mask[5, 1:] = False
    sample_mask = np.ones(len(mask), bool)
    sample_mask[[3, 4]] = False
    K, T, _ = batch.cameras
    return batch._replace(cameras=Cameras(K, T, mask), sample_mask=sample_mask)


@pytest.mark.slow
def test_overfits_one_batch(micro_params, config, batch_at):
    """Roots off centre: without any image the mean pose lowers the loss, but no key point is found.

    With all images blank the ratios are 0.75, 0.62 and 0.96; with these images 0.36, 0.44 and 0.02.
    """
    batch = batch_at(0, off_centre_m=0.08)
    optimizer = replace(config.optimizer, learning_rate=5e-3, eps=1e-8, schedule=Schedule.CONSTANT)
    config = replace(config, training_root=TrainingRoot(per_coordinate_m=0.0), optimizer=optimizer)
    step, state = one_device(config), create_state(micro_params, config)
    state, first = step(state, batch, KEY)
    for _ in range(60):
        state, last = step(state, batch, KEY)
    assert first["keypoint_px"] > 4
    for name, most in {"loss": 0.45, "mpvpe_mm": 0.52, "keypoint_px": 0.05}.items():
        assert last[name] < most * first[name], name


@pytest.mark.slow
def test_eight_devices():
    """The tests of a split over devices, of which the suite has two, in a process that has eight."""
    flags = os.environ["XLA_FLAGS"].replace("device_count=2", "device_count=8")
    devices = {"XLA_FLAGS": flags, "PJRT_NPROC": "12"}
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "0", "-m", "", "-k", "split or belongs", __file__],
        env=os.environ | devices,
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "2 passed" in ran.stdout, ran.stdout + ran.stderr


@pytest.mark.slow
def test_any_split_over_devices_gives_the_result_of_one(drawn_params, config, micro_batch, monkeypatch):
    """With the gradients that large kernels have on a CPU."""
    monkeypatch.setattr(layers, "_LEAST_GRADIENT_CHANNELS", 1)
    count = jax.device_count()
    assert count > 1
    batch = uneven(micro_batch)
    want, want_metrics = one_device(config)(create_state(drawn_params, config), batch, KEY)
    start = create_state(drawn_params, config)
    for now, then in ((want.params["trainable"], start.params["trainable"]), (want.ema, start.ema)):
        moves = [np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (now, then)), strict=True)]
        assert np.median(moves) > 10 * TOLERANCE["atol"]

    fresh = create_state(drawn_params, config)
    stacked = jax.tree.map(lambda x: jnp.stack([x] * count), fresh)
    got, metrics = pmap_step(config, jax.devices())(stacked, stack_for_devices(batch, count), KEY)
    compare(jax.tree.map(lambda x: x[-1], got), want)
    for name, value in want_metrics.items():
        np.testing.assert_allclose(metrics[name], np.full(count, value), rtol=1e-4)

    mesh = data_mesh()
    for kind in DataParallel:
        split = replace(config, train=replace(config.train, data_parallel=kind))
        state = jax.device_put(create_state(drawn_params, split), replicated(mesh))
        key = jax.device_put(KEY, replicated(mesh))
        got, metrics = compile_step(split, mesh)(state, put_batch(batch, mesh), key)
        compare(got, want)
        assert state.params["trainable"]["decoder"]["embeddings"].is_deleted()  # donated
        for name, value in want_metrics.items():
            np.testing.assert_allclose(metrics[name], value, rtol=1e-4)


@pytest.mark.slow
def test_parts_of_every_devices_share_are_those_of_one(drawn_params, config, micro_batch):
    """Also where insides are computed again, the batch norms' sums over devices with them."""
    mesh = data_mesh(jax.devices()[:2])
    assert mesh.size == 2
    batch = uneven(micro_batch)
    in_two = replace(config, compute=ComputeConfig(accumulate=2))
    want, want_metrics = one_device(in_two)(create_state(drawn_params, in_two), batch, KEY)
    lean = replace(in_two, compute=replace(in_two.compute, rematerialise=Rematerialise.BOTH))
    state = jax.device_put(create_state(drawn_params, lean), replicated(mesh))
    key = jax.device_put(KEY, replicated(mesh))
    got, metrics = compile_step(lean, mesh)(state, put_batch(batch, mesh), key)
    compare(got, want)
    for name, value in want_metrics.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-4, err_msg=name)


@pytest.mark.slow
def test_padding_changes_neither_weights_nor_statistics(drawn_params, config, batch_at):
    """A batch of 5 samples and 2 views equals one of 8 and 3 whose other entries are masked."""
    small = batch_at(1, batch=5, views=2)

    def padded(x, axes):
        widths = [(0, 3), (0, 1)][:axes] + [(0, 0)] * (x.ndim - axes)
        return np.pad(x, widths, mode="edge")

    per_view, per_sample = ("views", "keypoints_px"), ("joints_world", "vertices_world", "pose", "shape")
    K, T, mask = (padded(x, 2) for x in small.cameras)
    mask[:, 2] = False
    large = small._replace(
        **{name: padded(getattr(small, name), 2) for name in per_view},
        **{name: padded(getattr(small, name), 1) for name in per_sample},
        cameras=Cameras(K, T, mask),
        sample_mask=np.arange(8) < 5,
    )
    step = one_device(config)
    want, want_metrics = step(create_state(drawn_params, config), small, KEY)
    got, metrics = step(create_state(drawn_params, config), large, KEY)
    compare(got, want)
    np.testing.assert_allclose(metrics["loss"], want_metrics["loss"], rtol=1e-5)


def test_a_batch_without_anything_valid_is_finite(micro_params, config, micro_batch):
    empty = micro_batch._replace(sample_mask=np.zeros(8, bool))
    state, metrics = one_device(config)(create_state(micro_params, config), empty, KEY)
    assert metrics["loss"] == 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.params["trainable"]))


def test_triangulated_root_trains_too(micro_params, config, micro_batch):
    config = replace(config, training_root=TrainingRoot(source=RootSource.TRIANGULATED))
    _, metrics = one_device(config)(create_state(micro_params, config), micro_batch, KEY)
    assert all(np.isfinite(value) for value in metrics.values())


@pytest.mark.parametrize("noise", [TrainingRoot(), RELEASE_ROOT])
def test_root_noise_has_the_spread_of_its_recipe(noise):
    joints = np.zeros((4000, 21, 3), np.float32)
    roots = np.array([noisy_root(joints, noise, key=jax.random.key(i)) for i in range(40)])
    per_sample = (roots - roots.mean(1, keepdims=True)).std()
    np.testing.assert_allclose(per_sample, 0.01, rtol=0.03)
    shared = roots.mean((1, 2)).std()
    np.testing.assert_allclose(shared, noise.shared_m, rtol=0.4, atol=2e-4)


def test_root_noise_belongs_to_the_sample():
    joints = jax.random.normal(KEY, (8, 21, 3))
    draw = partial(noisy_root, noise=RELEASE_ROOT, key=KEY)
    shards = jax.pmap(partial(draw, axis_name="x"), axis_name="x", devices=jax.devices())
    split = shards(joints.reshape(jax.device_count(), -1, 21, 3))
    np.testing.assert_allclose(split.reshape(8, 3), draw(joints), rtol=1e-6)


def test_roots_astray_do_not_count_unless_the_recipe_says_so(micro_batch):
    """As given in `TrainingRoot.max_error_m`; a model without a root keeps all."""
    away = np.array([0.0, 0.05, 0.2, 3.0, 0.0, 0.0, 0.0, 0.0], np.float32)
    root = micro_batch.joints_world[:, ROOT_JOINT] + away[:, None] * np.array([0, 0.6, 0.8], np.float32)
    solved = np.array([True] * 7 + [False])
    found = Prediction(None, None, root, None, None, solved)
    for limit, expected in ((0.1, solved & (away < 0.1)), (1.0, solved & (away < 1)), (None, solved)):
        np.testing.assert_array_equal(near_the_hand(found, micro_batch, limit).valid, expected)
    np.testing.assert_array_equal(
        near_the_hand(found._replace(root_world=None), micro_batch, 0.1).valid, solved
    )
    with pytest.raises(ValueError, match=r"`max_error_m` must be positive, or None; got 0\.0"):
        TrainingRoot(max_error_m=0.0)


def test_first_stage_trains_the_heat_maps_alone(micro_params, config, micro_batch):
    """The decoder's gradients are zero, and Adam forgets them before the second stage begins."""
    first = jax.jit(partial(train_step, config=config, first_stage=True))
    state, metrics = first(create_state(micro_params, config), micro_batch, KEY)
    moments = first_moments(state)
    assert all(not leaf.any() for leaf in jax.tree.leaves(moments["decoder"]))
    assert any(leaf.any() for leaf in jax.tree.leaves(moments["heat_maps"]))
    assert metrics["keypoints"] > 0
    fresh = restart_moments(state)
    assert all(not leaf.any() for leaf in jax.tree.leaves(first_moments(fresh)))
    counts = optax.tree.get_all_with_path(fresh.opt_state, "count")
    assert sorted(int(count) for _, count in counts) == [0, 1]


def test_frozen_views_leave_all_that_looks_at_one_view(micro_params, config, micro_batch):
    """Weights and batch-norm statistics; and the views look as they do at inference."""
    frozen = replace(config, frozen_views=True, train=replace(config.train, init_from="somewhere"))
    state = create_state(micro_params, frozen)
    after, metrics = jax.jit(partial(train_step, config=frozen))(state, micro_batch, KEY)
    before = jax.tree.map(np.asarray, state.params)
    looking = ("trunk", "heat_maps", "features")
    for group, names in (("trainable", looking), ("statistics", before["statistics"])):
        for name in names:
            jax.tree.map(np.testing.assert_array_equal, after.params[group][name], before[group][name])
            if after.ema is not None:
                jax.tree.map(np.testing.assert_array_equal, after.ema[group][name], before[group][name])
    moved = jax.tree.map(lambda a, b: np.any(a != b), after.params["trainable"], before["trainable"])
    assert any(jax.tree.leaves(moved["decoder"]))
    seen = poem_jax.apply(micro_params, micro_batch.views, existing_views(micro_batch), config=config.model)
    truth = match_keypoints(seen.keypoints_px, micro_batch)
    mask = existing_views(micro_batch).view_mask
    error = np.linalg.norm(seen.keypoints_px - truth, axis=-1)[np.asarray(mask)].mean()
    np.testing.assert_allclose(metrics["keypoint_px"], error, rtol=1e-4)


def test_a_frozen_first_stage_leaves_trunk_and_heat_maps(micro_params, config, micro_batch):
    """The maps that the second stage reads learn, with the moments of the batch."""
    run = replace(config.train, first_stage_from="somewhere")
    frozen = replace(config, frozen_first_stage=True, train=run)
    state = create_state(micro_params, frozen)
    before = jax.tree.map(np.asarray, state.params)
    step, after = jax.jit(partial(train_step, config=frozen)), state
    for _ in range(2):  # The offsets begin at zero, and what is before them without a gradient.
        after, _ = step(after, micro_batch, KEY)
    for group in ("trainable", "statistics"):
        for name in ("trunk", "heat_maps"):
            jax.tree.map(np.testing.assert_array_equal, after.params[group][name], before[group][name])
    moved = jax.tree.map(lambda a, b: np.any(a != b), after.params["trainable"], before["trainable"])
    assert any(jax.tree.leaves(moved["features"]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"train": RunConfig()}, "`frozen_views` keeps what `train.init_from` gives"),
        ({"first_stage_steps": 3}, "`first_stage_steps` train what `frozen_views` keeps"),
        ({"optimizer": OptimizerConfig(weight_decay=0.1)}, "would shrink the weights"),
    ],
)
def test_frozen_views_refuse_what_would_move_them(config, change, message):
    started = replace(config, train=replace(config.train, init_from="somewhere"))
    with pytest.raises(ValueError, match=message):
        replace(started, frozen_views=True, **change)
