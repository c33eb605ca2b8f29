from dataclasses import replace

import pytest

from poem_jax import losses
from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.models.poem_v1_config import BallConfig
from poem_jax.models.presets import preset
from poem_jax.training.config import (
    RELEASE_ROOT,
    Clip,
    DataConfig,
    OptimizerConfig,
    RootSource,
    Schedule,
    TrainingRoot,
)
from poem_jax.training.recipes import experiment
from poem_jax.training.state import learning_rate

REST = {"name": "x", "model": preset("tiny"), "data": DataConfig(synthetic=benchmark)}


def test_the_release_supervises_the_last_layer_and_clips_every_tensor():
    config = experiment("release", **REST)
    assert config.loss is losses.RELEASE
    assert config.loss.layers is losses.Layers.LAST
    assert config.training_root is RELEASE_ROOT
    assert config.optimizer.clip is Clip.PER_TENSOR
    rate = learning_rate(config)
    steps = config.train.steps
    assert rate(int(0.69 * steps)) == pytest.approx(1e-4)
    assert rate(int(0.71 * steps)) == pytest.approx(1e-5)


def test_the_paper_supervises_every_layer_with_a_cosine():
    config = experiment("paper", **REST)
    assert config.loss.layers is losses.Layers.EVERY
    rate = learning_rate(config)
    assert rate(config.train.steps // 2) == pytest.approx(0.5e-4, rel=0.01)


def test_fields_of_a_recipe_can_be_replaced():
    optimizer = OptimizerConfig(schedule=Schedule.COSINE, clip=Clip.PER_TENSOR)
    assert experiment("release", **REST, optimizer=optimizer).optimizer is optimizer


def test_the_parametric_release_ends_at_a_thousandth_of_its_rate():
    config = experiment("release-mano", **REST)
    assert learning_rate(config)(config.train.steps) == pytest.approx(1e-7, rel=0.01)
    assert config.loss is losses.RELEASE


def test_poem_v1_trains_about_the_root_that_it_triangulates():
    """The release counts all samples, however far astray that root is."""
    own, released = (experiment(name, **REST).training_root for name in ("v1", "v1-release"))
    assert own == TrainingRoot(source=RootSource.TRIANGULATED)
    assert own.max_error_m == BallConfig().radius
    assert released == replace(own, max_error_m=None)


def test_unknown_recipes_are_named():
    with pytest.raises(ValueError, match=r"`recipe` must be one of \[.*'paper', .*'v1'.*\]; got 'mine'"):
        experiment("mine", **REST)
