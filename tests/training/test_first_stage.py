"""One first stage for several systems: what is lent, and what is said where it does not fit."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.experiments import open_experiment, v1_paper
from poem_jax.models.apply import init
from poem_jax.models.network import is_of_first_stage
from poem_jax.models.presets import preset
from poem_jax.training.first_stage import with_first_stage
from poem_jax.weights.store import expected_leaves, flatten
from tests.micro import MICRO


@pytest.fixture(scope="module")
def lent():
    return init(MICRO, key=jax.random.key(1))


def test_trunk_and_heat_maps_come_from_the_other_model_and_the_rest_stays(lent):
    other = replace(MICRO, decoder=replace(MICRO.decoder, num_layers=1))
    fresh = init(other, key=jax.random.key(2))
    ours, theirs, got = flatten(fresh), flatten(lent), flatten(with_first_stage(fresh, lent, "donor"))
    assert ours.keys() == got.keys()
    for name, leaf in got.items():
        source = theirs if name.split(".")[1] in ("trunk", "heat_maps") else ours
        np.testing.assert_array_equal(leaf, source[name])
    assert any(name.startswith("statistics.trunk") for name in got)


def test_another_trunk_is_refused_by_name(lent):
    wider = replace(MICRO, backbone=replace(MICRO.backbone, channels=(16, 32)))
    with pytest.raises(ValueError, match=r"donor must have this model.s trunk.*expected \w+\.trunk"):
        with_first_stage(init(wider, key=jax.random.key(2)), lent, "donor")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of", "experiments"),
    [
        ("v1", [f"v1_paper:{name}" for name in v1_paper.configs]),
        ("v2-base", [f"v2_{size}_six_sets" for size in ("small", "base", "large", "param")]),
    ],
)
def test_one_folder_lends_its_trunk_to_all_that_the_papers_tables_train(of, experiments):
    """So that an ImageNet trunk is imported once (docs/weights.md)."""
    lent = expected_leaves(preset(of))
    for model in {open_experiment(name).model for name in experiments}:
        wanted = {name: leaf for name, leaf in expected_leaves(model).items() if is_of_first_stage(name)}
        assert wanted
        for name, leaf in wanted.items():
            assert lent[name].shape == leaf.shape, (model, name)
