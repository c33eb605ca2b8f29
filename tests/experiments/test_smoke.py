"""`--smoke`: every experiment has a tiny likeness, and it trains."""

import pytest

from poem_jax.experiments import experiment_names, open_experiment
from poem_jax.experiments.parts import smoke as module
from poem_jax.experiments.parts.smoke import smoke
from poem_jax.mixture.config import SyntheticSource
from poem_jax.training.loop import train

KINDS = ("finetune", "v1_paper:v1-ho3d")
"""Captures with weights to start from, and tars; other tests train the other systems."""


@pytest.fixture
def writes_nothing(monkeypatch):
    """Stand-ins take seconds to draw."""
    for name in module.WRITERS:
        monkeypatch.setitem(module.WRITERS, name, lambda root: None)
    monkeypatch.setattr(module.captures, "write", lambda root: None)
    monkeypatch.setattr(module, "_write_weights", lambda model, folder: str(folder))


@pytest.mark.parametrize("name", [*experiment_names(), "v1_paper:ftl-meshtr-oakink", "v1_release:mvp-ho3d"])
def test_every_experiment_has_a_tiny_likeness_that_reads_its_kinds_of_data(name, writes_nothing, tmp_path):
    whole = open_experiment(name)
    tiny = smoke(whole, tmp_path)
    assert (tiny.train.steps, tiny.train.out) == (2, str(tmp_path / "run"))
    assert type(tiny.model) is type(whole.model)
    assert (tiny.loss, tiny.frozen_views, tiny.compute) == (whole.loss, whole.frozen_views, whole.compute)
    assert (tiny.train.init_from is None) == (whole.train.init_from is None)
    parts = [config.data.mixture.parts if config.data.mixture else () for config in (whole, tiny)]
    for real, stand_in in zip(*parts, strict=True):
        assert type(stand_in.source) is type(real.source)
        assert stand_in.views == real.views
        if not isinstance(real.source, SyntheticSource):
            assert str(tmp_path) in str(getattr(stand_in.source, "root", stand_in.source))


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_likeness_trains(name, tmp_path):
    assert int(train(smoke(open_experiment(name), tmp_path)).step) == 2
