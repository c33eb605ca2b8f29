"""The loop: exact resume, stopping, what it writes, and what it refuses."""

import json
import logging
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from poem_jax.io.stopping import Stopped
from poem_jax.training.checkpoints import Checkpoints, export_run
from poem_jax.training.config import DataParallel
from poem_jax.training.loop import check_finite, image_grid, stop_after_the_step, train
from poem_jax.training.source import synthetic_batches
from poem_jax.training.state import evaluation_params
from poem_jax.weights.store import load


def with_run(config, **options):
    return replace(config, train=replace(config.train, **options))


def lines(config):
    return [json.loads(line) for line in (Path(config.train.out) / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(autouse=True)
def two_devices(monkeypatch):
    """The loop takes every device it finds; two are enough here and compile faster."""
    devices = jax.devices()[:2]
    monkeypatch.setattr(jax, "devices", lambda *_: devices)


@pytest.mark.slow
def test_two_and_two_steps_equal_four(micro_config, batch_at, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    whole = train(micro_config, batch_at=batch_at)
    broken = with_run(micro_config, out=str(tmp_path / "broken"))
    train(with_run(broken, steps=2), batch_at=batch_at)
    resumed = train(broken, batch_at=batch_at)
    assert int(resumed.step) == 4
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)

    steps = [line["step"] for line in lines(micro_config)]
    assert steps == [2, 4]
    assert {"loss", "mpvpe_mm", "gradient_norm", "learning_rate"} <= lines(micro_config)[0].keys()
    text = caplog.text
    for part in (
        "devices",
        "trainable parameters",
        "git commit",
        f"config in {micro_config.train.out}",
        "compiling the step for 8 samples of 3 views, once",
        "batch {'views': (8, 3, 32, 32, 3)",
    ):
        assert part in text
    assert "resumed at step 2" in text
    run = Path(micro_config.train.out)
    assert (run / "input_step0.png").is_file()
    assert json.loads((run / "train_config.json").read_text())["name"] == "micro"
    assert (run / "git_commit.txt").read_text().strip()


@pytest.mark.slow
def test_a_run_in_sittings_passes_from_stage_to_stage_as_a_whole_one(
    micro_config, batch_at, tmp_path, caplog
):
    """A sitting that ends between the stages leaves the new start of Adam's moments to the next one."""
    caplog.set_level(logging.INFO)
    config = with_run(replace(micro_config, first_stage_steps=2), steps=3)
    whole = train(config, batch_at=batch_at)
    broken = with_run(config, out=str(tmp_path / "broken"))
    train(with_run(broken, steps=2), batch_at=batch_at)
    resumed = train(broken, batch_at=batch_at)
    assert "resumed at step 2" in caplog.text
    assert int(resumed.step) == 3
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)


@pytest.mark.slow
def test_export_writes_the_averages_of_the_newest_checkpoint(micro_config, batch_at, tmp_path):
    state = train(micro_config, batch_at=batch_at)
    assert export_run(micro_config, tmp_path / "model", dtype=None) == 4
    config, params = load(tmp_path / "model")
    assert config == micro_config.model
    jax.tree.map(np.testing.assert_array_equal, params, evaluation_params(state))


def test_a_non_finite_loss_stops_the_run_and_names_the_step(micro_config, batch_at):
    def poisoned(step):
        batch = batch_at(step)
        if step == 3:
            batch = batch._replace(vertices_world=np.full_like(batch.vertices_world, np.nan))
        return batch

    config = with_run(micro_config, steps=8, log_every=4)
    with pytest.raises(FloatingPointError, match=r"'loss': nan.* at step 3 .*lower the learning rate"):
        train(config, batch_at=poisoned)
    with Checkpoints(config.train.out, config) as checkpoints:
        assert checkpoints.latest_step == 2


def test_check_finite_names_the_first_bad_step():
    good, bad = {"loss": 1.0, "pose": 2.0}, {"loss": 1.0, "pose": np.inf}
    check_finite([(5, good), (6, good)])
    with pytest.raises(FloatingPointError, match=r"\{'pose': inf\} at step 6 \(steps 5 to 7"):
        check_finite([(5, good), (6, bad), (7, bad)])


def test_a_time_limit_and_a_signal_end_with_a_checkpoint(micro_config, batch_at):
    timed = with_run(micro_config, steps=10**6, max_minutes=1e-9)
    assert int(train(timed, batch_at=batch_at).step) == 0

    def slow(step):
        if step == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.05)
        return batch_at(step)

    endless = with_run(micro_config, steps=10**6, checkpoint_every=10**6)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(Stopped, match="SIGTERM"):
        train(endless, batch_at=slow)
    with Checkpoints(endless.train.out, endless) as checkpoints:
        assert 0 < checkpoints.latest_step < 100
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_second_signal_ends_at_once():
    def step():
        with stop_after_the_step() as stopped:
            os.kill(os.getpid(), signal.SIGTERM)
            assert stopped.wait(5)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
            raise AssertionError("the step went on")

    with pytest.raises(Stopped, match="SIGINT"):
        step()


def test_another_config_is_refused_and_the_flag_named(micro_config, batch_at):
    config = with_run(micro_config, steps=2)
    train(config, batch_at=batch_at)
    other = replace(config, optimizer=replace(config.optimizer, learning_rate=0.5))
    with pytest.raises(
        ValueError, match=r"optimizer.learning_rate: 0.001 -> 0.5.*--train.allow-config-change"
    ):
        train(other, batch_at=batch_at)
    train(with_run(config, log_every=1, max_minutes=3.0), batch_at=batch_at)
    train(with_run(other, allow_config_change=True), batch_at=batch_at)


def test_synthetic_batches_depend_on_the_step_alone(micro_config):
    shape = replace(micro_config.data.batches[0], batch_size=2, min_views=1)
    data = replace(micro_config.data, batches=(shape,))
    one, other = synthetic_batches(data), synthetic_batches(data)
    other(0)
    jax.tree.map(np.testing.assert_array_equal, one(5), other(5))
    assert np.any(one(5).views != one(6).views)
    assert one(5).views.shape == (2, 3, 32, 32, 3)


def test_batches_must_split_over_the_devices_that_are_there(micro_config, batch_at, monkeypatch):
    devices = jax.devices("cpu")
    monkeypatch.setattr(jax, "devices", lambda *_: [*devices, devices[0]])
    with pytest.raises(ValueError, match=r"multiple of the number of devices, 3; got \[8\]"):
        train(micro_config, batch_at=batch_at)
    assert not Path(micro_config.train.out).exists()
    monkeypatch.setattr(jax, "devices", lambda *_: devices)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(ValueError, match="one process on the devices of one machine; got 2"):
        train(micro_config, batch_at=batch_at)


def test_errors_of_the_source_arrive(micro_config):
    def broken(step):
        raise OSError(f"disk gone at {step}")

    with pytest.raises(OSError, match="disk gone at 0"):
        train(micro_config, batch_at=broken)


@pytest.mark.slow
def test_validation_and_jit_sharding_run(micro_config, batch_at):
    config = with_run(
        micro_config,
        steps=2,
        validate_every=2,
        validation_samples=8,
        validation_views=(2,),
        data_parallel=DataParallel.JIT,
    )
    train(config, batch_at=batch_at)
    validation = lines(config)[-1]
    assert validation["group"] == "validation"
    for name in ("mpvpe_mm_2views", "root_mm_2views", "true_root_mpvpe_mm_2views"):
        assert np.isfinite(validation[name])


def test_image_grid_lays_out_samples_and_views(micro_batch):
    grid = image_grid(micro_batch.views)
    assert grid.shape == (4 * 32, 3 * 32, 3)
    np.testing.assert_array_equal(grid[32:64, 64:96], micro_batch.views[1, 2])
    assert image_grid(micro_batch.views / 255.0).dtype == np.uint8
