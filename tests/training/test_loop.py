"""The loop: exact resume, stopping, what it writes, and what it refuses.

What is not slow here trains a stand-in of three weights, whose step compiles at once.
"""

import json
import logging
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.data.augmentation_recipes import PAPER
from poem_jax.io.stopping import Stopped
from poem_jax.mixture.config import CapturesSource, MixtureConfig, Part
from poem_jax.mixture.workers import WorkerDied
from poem_jax.training import initial_state, loop
from poem_jax.training.checkpoint_errors import CheckpointNotWritten
from poem_jax.training.checkpoints import Checkpoints, export_run
from poem_jax.training.config import DataParallel
from poem_jax.training.journal import Journal
from poem_jax.training.loop import STOP_EVERY, train
from poem_jax.training.pictures import image_grid
from poem_jax.training.run_report import Sitting
from poem_jax.training.source import synthetic_batches
from poem_jax.training.state import evaluation_params
from poem_jax.training.stopping import stop_after_the_step
from poem_jax.weights.store import load


def with_run(config, **options):
    return replace(config, train=replace(config.train, **options))


def lines(config, group=None):
    found = [json.loads(line) for line in (Path(config.train.out) / "metrics.jsonl").read_text().splitlines()]
    return [line for line in found if group in (None, line["group"])]


def report(config):
    return json.loads((Path(config.train.out) / "report.json").read_text())


@pytest.fixture(autouse=True)
def two_devices(monkeypatch):
    """The loop takes every device it finds; two are enough here and compile faster."""
    devices = jax.devices()[:2]
    monkeypatch.setattr(jax, "devices", lambda *_: devices)


@pytest.fixture
def light(monkeypatch):
    """A model of three weights: its loss is the batch's mean vertex coordinate, and weighs them."""

    def light_step(config, mesh, *, first_stage=False):
        def step(state, batch, key):
            loss = jnp.mean(batch.vertices_world)
            metrics = {"loss": loss, "mpvpe_mm": loss}
            if config.train.skip_bad_steps:
                metrics["bad_step"] = 1.0 - jnp.isfinite(loss)
            moved = jax.tree.map(lambda leaf: leaf + jnp.nan_to_num(loss), state.params["trainable"])
            return state._replace(step=state.step + 1, params={**state.params, "trainable": moved}), metrics

        return jax.jit(step, donate_argnums=0)

    few = {"trainable": {"w": np.zeros(3, np.float32)}, "statistics": {}, "constants": {}}
    monkeypatch.setattr(initial_state, "init", lambda model, key: few)
    monkeypatch.setattr(loop, "compile_step", light_step)


@pytest.fixture
def poisoned(batch_at):
    """Give a source whose batches of these steps have no vertices."""

    def make(*steps):
        def draw(step):
            batch = batch_at(step)
            if step not in steps:
                return batch
            return batch._replace(vertices_world=np.full_like(batch.vertices_world, np.nan))

        return draw

    return make


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


def test_a_non_finite_loss_stops_the_run_and_keeps_the_batch(micro_config, poisoned, light):
    config = with_run(micro_config, steps=8, log_every=4)
    with pytest.raises(
        FloatingPointError, match=r"'loss': nan.* at step 3; the batch is in .*bad_step_3.npz"
    ):
        train(config, batch_at=poisoned(3))
    with Checkpoints(config.train.out, config) as checkpoints:
        assert checkpoints.latest_step == 2
    assert (Path(config.train.out) / "bad_step_3.png").is_file()
    assert report(config)["end"].startswith("failed: FloatingPointError: training stopped: {'loss': nan")
    assert report(config)["checkpoints"]["newest"] == 2


def test_bad_steps_are_left_out_until_there_are_too_many(micro_config, poisoned, light):
    config = with_run(micro_config, steps=6, skip_bad_steps=3)
    train(config, batch_at=poisoned(1, 2, 3))
    assert [line["bad_steps"] for line in lines(config)] == [1, 2, 0]
    assert ["loss" in line for line in lines(config)] == [True, False, True]
    assert "bad_step" not in lines(config)[0]
    assert report(config)["sitting"]["steps_left_out"] == [1, 2, 3]
    fewer = with_run(config, steps=6, skip_bad_steps=1, out=config.train.out + "_2")
    with pytest.raises(FloatingPointError, match=r"at step 2; .*bad step 2 of this sitting"):
        train(fewer, batch_at=poisoned(1, 2, 3))
    with Checkpoints(fewer.train.out, fewer) as checkpoints:
        assert checkpoints.latest_step == 2


def test_one_batch_goes_to_the_devices_while_a_step_runs(micro_config, batch_at, light, monkeypatch):
    """The next batch is placed before anything waits for the step; none is placed that is not needed."""
    events = []
    light_step = loop.compile_step

    def noted_step(config, mesh, **options):
        step = light_step(config, mesh, **options)

        def noted(*arguments):
            events.append("step")
            return step(*arguments)

        return noted

    put, write = loop.put_batch, Journal.write
    monkeypatch.setattr(loop, "compile_step", noted_step)
    monkeypatch.setattr(loop, "put_batch", lambda *given: events.append("place") or put(*given))
    monkeypatch.setattr(
        Journal, "write", lambda *given, **more: events.append("log") or write(*given, **more)
    )
    train(micro_config, batch_at=batch_at)
    assert events == ["place", *["step", "place"], *["step", "place", "log"], "step", "place", "step", "log"]


def test_costs_are_in_the_journal(micro_config, batch_at, light):
    def slow(step):
        time.sleep(0.15)
        return batch_at(step)

    config = replace(micro_config, data=replace(micro_config.data, prefetch=1))
    train(with_run(config, steps=12, log_every=6, checkpoint_every=99), batch_at=slow)
    last = lines(micro_config)[-1]
    assert 0 < last["samples_per_second"] == pytest.approx(8 * last["steps_per_second"])
    assert 0.3 < last["data_wait_share"] <= 1
    assert last["peak_memory_mb"] > 50


def ends(config, batch_at, kind):
    """Train until the error; return its report, and the newest checkpoint."""
    with pytest.raises(kind) as caught:
        train(config, batch_at=batch_at)
    found = report(config)
    assert found["end"] == f"failed: {kind.__name__}: {caught.value}"
    with Checkpoints(config.train.out, config) as checkpoints:
        assert found["checkpoints"]["newest"] == checkpoints.latest_step
        return found, checkpoints.latest_step


@pytest.mark.parametrize("error", [OSError("disk gone"), WorkerDied("worker 3 was killed")])
def test_an_error_of_the_source_costs_no_finished_step(micro_config, batch_at, light, error):
    """Step 2 is finished, and has its line and its checkpoint, when the batch after it cannot be drawn."""

    def broken(step):
        if step == 2:
            raise error
        return batch_at(step)

    found, newest = ends(micro_config, broken, type(error))
    assert (found["step"], newest) == (2, 2)
    assert [line["step"] for line in lines(micro_config)] == [2]
    assert found["to_go_on"] == "the same command again"


def test_a_full_disk_ends_a_run_with_a_report(micro_config, batch_at, light, monkeypatch):
    checksums = Checkpoints._write_checksums

    def full(self, step):
        if step == 4:
            raise OSError(28, "No space left on device")
        checksums(self, step)

    monkeypatch.setattr(Checkpoints, "_write_checksums", full)
    found, _ = ends(with_run(micro_config, steps=6), batch_at, CheckpointNotWritten)
    assert "checkpoint 4 in" in found["end"]
    assert "No space left" in found["end"]
    monkeypatch.undo()
    assert (Path(micro_config.train.out) / "seals" / "2.json").is_file()


def test_no_batch_is_placed_for_a_step_that_will_not_be(micro_config, batch_at, light, monkeypatch):
    placed = []
    put = loop.put_batch
    monkeypatch.setattr(loop, "put_batch", lambda *given: placed.append(1) or put(*given))
    monkeypatch.setattr(loop._Run, "_announce", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(Stopped):
        train(micro_config, batch_at=batch_at)
    assert (len(placed), report(micro_config)["step"]) == (1, 1)


class LightValidation:
    """Errors that grow from the second validation on."""

    def __init__(self, config, mesh, mixture):
        self.views = config.train.validation_views

    def __call__(self, state):
        return {f"mpvpe_mm_{n}views": 10.0 + abs(float(state.step) - 3) for n in self.views}

    def score(self, metrics):
        return min(metrics.values())

    def panel(self, state):
        return np.full((4, 4, 3), int(state.step), np.uint8)


def test_the_best_checkpoint_has_the_score_of_its_own_weights(micro_config, batch_at, light, monkeypatch):
    saved = []
    monkeypatch.setattr(loop, "Validation", LightValidation)
    save = Checkpoints.save

    def noted(self, state, *, wait=False, score=None):
        saved.append((int(state.step), score))
        save(self, state, wait=wait, score=score)

    monkeypatch.setattr(Checkpoints, "save", noted)
    data = replace(micro_config.data, synthetic=replace(micro_config.data.synthetic, num_views=8))
    config = with_run(replace(micro_config, data=data), steps=6, checkpoint_every=4, validate_every=3)
    train(config, batch_at=batch_at)
    assert saved == [(4, None), (6, 13.0)]
    assert [line["step"] for line in lines(config, "validation")] == [3, 6]
    saved.clear()
    best = with_run(config, keep_best=True, out=config.train.out + "_best")
    train(best, batch_at=batch_at)
    assert saved == [(3, 10.0), (4, None), (6, 13.0), (6, 13.0)]


@pytest.mark.parametrize("keep_best", [True, False])
def test_a_run_that_starts_from_a_model_measures_it_first(
    micro_config, batch_at, light, monkeypatch, tmp_path, keep_best
):
    """Once, also where it was killed; where the best is kept and training only harms, it is the best."""
    errors = {0: 5.0, 2: 7.0, 4: 9.0}

    class Harmed(LightValidation):
        def __call__(self, state):
            return {"mpvpe_mm_2views": errors[int(state.step)]}

    monkeypatch.setattr(loop, "Validation", Harmed)
    monkeypatch.setattr(
        initial_state, "load", lambda folder, expected: (expected, initial_state.init(expected, key=None))
    )
    ratio = micro_config.model.crop.ratio
    mixture = MixtureConfig(
        (Part(CapturesSource((str(tmp_path),)), held_out=0.5),),
        recipe=replace(PAPER, box_ratio=ratio),
    )
    data = replace(micro_config.data, mixture=None if keep_best else mixture)
    options = {"init_from": "m", "validate_every": 2, "validation_views": (2,), "keep_checkpoints": 1}
    config = with_run(replace(micro_config, data=data), keep_best=keep_best, **options)

    def dies(step):
        if step == 1:
            raise OSError("killed")
        return batch_at(step)

    with pytest.raises(OSError, match="killed"):
        train(config, batch_at=dies)
    assert [line["step"] for line in lines(config, "validation")] == [0]
    train(config, batch_at=batch_at)
    assert [line["step"] for line in lines(config, "validation")] == [0, 2, 4]
    assert report(config)["best"]["mpvpe_mm_2views"] == {"value": 5.0, "step": 0}
    with Checkpoints(config.train.out, config) as checkpoints:
        assert (checkpoints.steps, checkpoints.best_step) == (([4, 0], 0) if keep_best else ([4], 4))
    fresh = with_run(config, init_from=None, out=config.train.out + "_fresh")
    train(fresh, batch_at=batch_at)
    assert [line["step"] for line in lines(fresh, "validation")] == [2, 4]


def test_pictures_of_held_out_samples(micro_config, batch_at, light, monkeypatch):
    monkeypatch.setattr(loop, "Validation", LightValidation)
    config = with_run(micro_config, panel_every=2, validation_views=(2,))
    train(config, batch_at=batch_at)
    panels = sorted((Path(config.train.out) / "panels").iterdir())
    assert [file.name for file in panels] == ["step_0000002.png", "step_0000004.png"]
    assert "step_0000004.png" in (Path(config.train.out) / "report.html").read_text()


def test_a_time_limit_and_a_signal_end_with_a_checkpoint(micro_config, batch_at, light, caplog):
    caplog.set_level(logging.INFO)
    timed = with_run(micro_config, steps=10**6, max_minutes=1e-9)
    assert int(train(timed, batch_at=batch_at, command="poem train x").step) == 0
    assert "to go on: poem train x" in caplog.text
    assert report(timed)["end"] == "the time of `train.max_minutes` was over"

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
        assert report(endless)["checkpoints"]["newest"] == checkpoints.latest_step
    assert report(endless)["end"] == "stopped by SIGTERM"
    assert "to go on: the same command again" in caplog.text
    assert signal.getsignal(signal.SIGTERM) is before


def test_several_hosts_ask_each_other_at_the_same_steps(micro_config, monkeypatch):
    asked = []

    def another_stops(flag):
        asked.append(flag)
        return True

    run = SimpleNamespace(config=micro_config, sitting=Sitting(micro_config))
    stopped = threading.Event()
    should_stop = loop._Run._should_stop
    assert not should_stop(run, 1, stopped)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(loop, "any_host", another_stops)
    steps = [n for n in range(3 * STOP_EVERY) if should_stop(run, n, stopped)]
    assert steps == [0, STOP_EVERY, 2 * STOP_EVERY]
    assert asked == [False] * 3
    assert run.sitting.stopped_early.startswith("stopped by another host")


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


def test_another_config_is_refused_and_the_flag_named(micro_config, batch_at, light):
    config = with_run(micro_config, steps=2)
    train(config, batch_at=batch_at)
    other = replace(config, optimizer=replace(config.optimizer, learning_rate=0.5))
    with pytest.raises(
        ValueError, match=r"optimizer.learning_rate: 0.001 -> 0.5.*--train.allow-config-change"
    ):
        train(other, batch_at=batch_at)
    assert report(config)["end"] == "finished"
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


def test_errors_of_the_source_arrive(micro_config, light):
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
