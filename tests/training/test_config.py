"""Experiment files, overrides, and the comparison of configs."""

import json
import shutil
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch
from poem_jax.experiments import experiment_names, open_experiment
from poem_jax.geometry.cameras import Cameras
from poem_jax.models.config import HRNetConfig
from poem_jax.models.network import describe
from poem_jax.training.config import (
    BatchShape,
    DataConfig,
    OptimizerConfig,
    RunConfig,
    TrainConfig,
    config_json,
    differences,
    flatten_config,
    git_commit,
)
from poem_jax.training.state import create_state
from poem_jax.training.step import train_step

EXPERIMENTS = experiment_names()


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_builds(name):
    """Shapes only; nothing is computed."""
    config = open_experiment(name)
    state = jax.eval_shape(partial(create_state, config=config), describe(config.model))
    assert sum(leaf.size for leaf in jax.tree.leaves(state.params["trainable"])) > 1e6


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_model_says_what_crops_it_is_trained_on(name):
    config = open_experiment(name)
    assert config.model.crop.ratio == config.data.synthetic.crop.expand_ratio
    assert not config.model.crop.upright


def abstract_batch(config: TrainConfig) -> MultiViewBatch:
    """Shapes of the experiment's largest batch."""
    kind = max(config.data.batches, key=lambda shape: shape.num_views)
    n, v = kind.batch_size, kind.num_views

    def array(*shape, dtype=np.float32):
        return jax.ShapeDtypeStruct((n, *shape), dtype)

    return MultiViewBatch(
        views=array(v, *config.model.image_hw, 3, dtype=np.uint8),
        cameras=Cameras(array(v, 3, 3), array(v, 4, 4), array(v, dtype=bool)),
        joints_world=array(21, 3),
        vertices_world=array(778, 3),
        keypoints_px=array(v, 21, 2),
        pose=array(16, 3),
        shape=array(10),
        sample_mask=array(dtype=bool),
    )


def with_thin_trunk(config: TrainConfig) -> TrainConfig:
    """Take one block where HRNet has several of a shape: tracing the gradient of all takes minutes."""
    if not isinstance(config.model.backbone, HRNetConfig):
        return config
    trunk = replace(config.model.backbone, stem_blocks=2, modules=(1, 1, 1), blocks=1)
    return replace(config, model=replace(config.model, backbone=trunk))


def steps() -> list:
    """One experiment of those whose steps are alike."""
    alike: dict[tuple, list[str]] = {}
    for name in EXPERIMENTS:
        config = open_experiment(name)
        optimizer, shape = config.optimizer, abstract_batch(config).views.shape
        step = (
            (config.model, config.loss, config.training_root, config.compute, config.frozen_views, shape),
            (config.first_stage_steps > 0, bool(optimizer.ema_decay), bool(optimizer.weight_decay)),
            optimizer.clip,
        )
        alike.setdefault(step, []).append(name)
    return [
        pytest.param(
            names[0],
            id=" ".join(names),
            marks=[pytest.mark.slow] if isinstance(model.backbone, HRNetConfig) else [],
        )
        for ((model, *_), *_), names in alike.items()
    ]


@pytest.mark.parametrize("name", steps())
def test_the_step_of_every_experiment_fits_its_model_and_data(name):
    """Shapes only: the next state has the form of the last, and every metric is a number."""
    config = with_thin_trunk(open_experiment(name))
    state = jax.eval_shape(partial(create_state, config=config), describe(config.model))
    key = jax.eval_shape(lambda: jax.random.key(0))
    after, metrics = jax.eval_shape(partial(train_step, config=config), state, abstract_batch(config), key)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(
        lambda x: (x.shape, x.dtype), state
    )
    assert {"loss", "mpvpe_mm", "gradient_norm"} <= metrics.keys()
    assert ("keypoint_px" in metrics) == config.model.triangulates
    assert all(value.shape == () for value in metrics.values())


def test_cross_field_rules(micro_config):
    with pytest.raises(ValueError, match=r"multiple of `train.host_devices` = 3; got \[8\]"):
        replace(micro_config, train=RunConfig(host_devices=3))
    with pytest.raises(ValueError, match=r"`min_views` must lie in 1..num_views = 2; got 3"):
        BatchShape(num_views=2, min_views=3)
    with pytest.raises(ValueError, match="at least one shape"):
        DataConfig(batches=())
    small = replace(micro_config.data.synthetic, image_hw=(64, 64))
    with pytest.raises(ValueError, match=r"must be the model's \(32, 32\); got \(64, 64\)"):
        replace(micro_config, data=replace(micro_config.data, synthetic=small))
    with pytest.raises(ValueError, match=r"asks for 4 views, but `data.synthetic.num_views` is 3"):
        replace(micro_config, data=replace(micro_config.data, batches=(BatchShape(4, 8),)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"log_every": 0}, "`train.log_every` must be at least 1; got 0"),
        ({"checkpoint_every": 0}, "`train.checkpoint_every` must be at least 1; got 0"),
        ({"keep_checkpoints": 0}, "`train.keep_checkpoints` must be at least 1; got 0"),
        ({"validate_every": -1}, "`train.validate_every` must be at least 0; got -1"),
        ({"validation_samples": 0}, "`train.validation_samples` must be at least 1; got 0"),
        ({"host_devices": 0}, "`train.host_devices` must be at least 1; got 0"),
        ({"max_minutes": 0.0}, "`train.max_minutes` must be positive, or None; got 0.0"),
        ({"validation_views": ()}, r"`train.validation_views` must name view counts from 1; got \(\)"),
        ({"validation_views": (0, 2)}, r"`train.validation_views` must name .*; got \(0, 2\)"),
    ],
)
def test_rules_of_a_run(options, message):
    with pytest.raises(ValueError, match=message):
        RunConfig(**options)


def test_validation_needs_cameras_that_exist(micro_config):
    run = replace(micro_config.train, validation_views=(9,))
    replace(micro_config, train=run)
    with pytest.raises(ValueError, match=r"must not exceed `data.synthetic.num_views` = 3; got \(9,\)"):
        replace(micro_config, train=replace(run, validate_every=1))


def test_the_commit_is_the_packages_own(tmp_path, monkeypatch):
    """Not that of the folder one happens to stand in, nor that of a project into which it is installed."""

    def git(*arguments):
        user = ("-c", "user.name=n", "-c", "user.email=n@e.invalid")
        done = subprocess.run(["git", *user, *arguments], cwd=tmp_path, check=True, capture_output=True)
        return done.stdout.decode().strip()

    (tmp_path / "module.py").write_text("")
    (tmp_path / "installed.py").write_text("")
    if shutil.which("git") is None:
        pytest.skip("needs git")
    assert git_commit(tmp_path / "module.py") == "unknown"
    git("init", "-q")
    git("add", "module.py")
    git("commit", "-q", "-m", "first")
    assert git_commit(tmp_path / "module.py") == git("rev-parse", "HEAD")
    assert git_commit(tmp_path / "installed.py") == "unknown"
    (tmp_path / "module.py").write_text("changed = 1")
    assert git_commit(tmp_path / "module.py") == git("rev-parse", "HEAD") + "+changes"
    before = git_commit().removesuffix("+changes")
    monkeypatch.chdir(tmp_path)
    assert git_commit().removesuffix("+changes") == before != git("rev-parse", "HEAD")


def test_a_longer_run_is_another_run_only_if_its_schedule_spans_it(micro_config):
    longer = replace(micro_config, train=replace(micro_config.train, steps=9))
    assert differences(flatten_config(micro_config), flatten_config(longer)) == []
    open_ended = [replace(c, optimizer=OptimizerConfig()) for c in (micro_config, longer)]
    assert differences(*map(flatten_config, open_ended)) == ["optimizer.decay_steps: 4 -> 9"]


def test_differences_name_the_field_and_leave_bookkeeping_out(micro_config):
    other = replace(
        micro_config,
        train=replace(micro_config.train, out="elsewhere", log_every=7, seed=5),
        optimizer=replace(micro_config.optimizer, learning_rate=0.5),
    )
    assert differences(flatten_config(micro_config), flatten_config(other)) == [
        "optimizer.learning_rate: 0.001 -> 0.5",
        "train.seed: 0 -> 5",
    ]
    assert '"model.backbone.stem": "space_to_depth"' in config_json(micro_config)


def test_configs_hash_and_compare(micro_config):
    assert isinstance(micro_config, TrainConfig)
    assert hash(micro_config) == hash(replace(micro_config))


def test_runs_of_earlier_versions_go_on():
    """Fields that the stored config does not name had no other value then."""
    file = Path(__file__).with_name("run_config_of_november_2026.json")
    then, now = json.loads(file.read_text()), flatten_config(open_experiment("v2_nano_synthetic"))
    assert then.keys() < now.keys()
    assert differences(then, now) == []
    assert differences(then, {**now, "frozen_views": True}) == ["frozen_views: False -> True"]
