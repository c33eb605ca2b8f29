"""Errors of a model whose second stage is given other features, on captures and a model made up here."""

import jax
import numpy as np
import pytest

import poem_jax
from poem_jax.data.batching import collate
from poem_jax.evaluation.stages import FeatureErrors, errors_by_features, paired_difference
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset

VIEWS, SAMPLES = 2, 4


@pytest.fixture(scope="module")
def captures(micro_model) -> SyntheticDataset:
    config, _ = micro_model
    synthetic = SyntheticConfig(image_hw=config.image_hw, num_views=VIEWS, num_backgrounds=2)
    return SyntheticDataset(synthetic, seed=3)


@pytest.fixture(scope="module")
def errors(micro_model, captures) -> FeatureErrors:
    config, params = micro_model
    return errors_by_features(params, config, captures, samples=SAMPLES, num_views=VIEWS, batch_size=SAMPLES)


def test_its_own_features_give_what_apply_gives(micro_model, captures, errors) -> None:
    config, params = micro_model
    batch = collate([captures.sample(i, num_views=VIEWS) for i in range(SAMPLES)], VIEWS)
    found = poem_jax.apply(params, batch.views, batch.cameras, config=config)
    expected = 1000 * np.linalg.norm(found.vertices_world - batch.vertices_world, axis=-1).mean(-1)
    np.testing.assert_allclose(errors.own, expected, rtol=1e-4)


def test_a_second_stage_that_moves_nothing_does_not_notice(errors) -> None:
    """A fresh model starts at the template and moves nothing, whatever it reads."""
    for other in (errors.zero, errors.another):
        assert paired_difference(other, errors.own) == (0.0, 0.0)


def test_a_second_stage_that_reads_its_features_does(micro_model, captures) -> None:
    """The same model once its last layer moves the queries."""
    config, params = micro_model
    rng = np.random.default_rng(0)

    def disturb(leaf):
        return np.asarray(leaf + 0.05 * rng.normal(size=leaf.shape), np.float32)

    disturbed = {**params, "trainable": jax.tree.map(disturb, params["trainable"])}
    errors = errors_by_features(
        disturbed, config, captures, samples=SAMPLES, num_views=VIEWS, batch_size=SAMPLES
    )
    for other in (errors.zero, errors.another):
        assert np.abs(other - errors.own).max() > 1e-3


def test_a_paired_difference_is_of_the_pairs() -> None:
    reference = np.array([1.0, 50.0, 9.0, 20.0])
    mean, error = paired_difference(reference + np.array([1.0, 3.0, 1.0, 3.0]), reference)
    assert mean == pytest.approx(2)
    assert error == pytest.approx(np.sqrt(4 / 3) / 2)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ({"samples": 5, "batch_size": 4}, "multiple of `batch_size`.*got 5 and 4"),
        ({"samples": 1, "batch_size": 1}, "at least 2.*got 1 and 1"),
        ({"num_views": 1, "batch_size": 4}, "`num_views` must be at least 2"),
    ],
)
def test_counts_are_checked(micro_model, captures, counts: dict, message: str) -> None:
    config, params = micro_model
    with pytest.raises(ValueError, match=message):
        errors_by_features(params, config, captures, **{"samples": 4, "num_views": 2} | counts)
