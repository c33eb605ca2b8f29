"""`--smoke`: every experiment has a tiny likeness, and it trains."""

from dataclasses import replace

import pytest

from poem_jax.experiments import experiment_names, open_experiment
from poem_jax.experiments.parts import smoke as module
from poem_jax.experiments.parts.smoke import smoke
from poem_jax.mixture.config import Part, ReleasedTarsSource, SyntheticSource
from poem_jax.training.loop import train

FINETUNE = open_experiment("finetune")
KINDS = ("finetune", "v1_paper:v1-ho3d")
"""Captures with weights to start from, and tars; other tests train the other systems."""


@pytest.fixture
def writes_nothing(monkeypatch):
    """Stand-ins take seconds to draw."""
    for name in module.WRITERS:
        monkeypatch.setitem(module.WRITERS, name, lambda root: None)
    monkeypatch.setattr(module.captures, "write", lambda root: None)
    monkeypatch.setattr(module, "_write_weights", lambda model, folder: str(folder))


@pytest.mark.parametrize(
    "name",
    [
        *experiment_names(),
        "v1_paper:ftl-meshtr-oakink",
        "v1_release:mvp-ho3d",
        "v2_medium_six_sets:v2-medium-mano-release",
    ],
)
def test_every_experiment_has_a_tiny_likeness_that_reads_its_kinds_of_data(name, writes_nothing, tmp_path):
    whole = open_experiment(name)
    tiny = smoke(whole, tmp_path)
    assert (tiny.train.steps, tiny.train.out) == (2, str(tmp_path / "run"))
    assert type(tiny.model) is type(whole.model)
    assert (tiny.loss, tiny.frozen_views, tiny.compute) == (whole.loss, whole.frozen_views, whole.compute)
    assert (tiny.train.init_from is None) == (whole.train.init_from is None)
    assert (tiny.train.panel_every == tiny.train.steps) == (whole.train.panel_every > 0)
    parts = [config.data.mixture.parts if config.data.mixture else () for config in (whole, tiny)]
    for real, stand_in in zip(*parts, strict=True):
        assert type(stand_in.source) is type(real.source)
        assert stand_in.views == real.views
        if not isinstance(real.source, SyntheticSource):
            assert str(tmp_path) in str(getattr(stand_in.source, "root", stand_in.source))


def on_tars(*paths, split=None):
    mixture = replace(FINETUNE.data.mixture, parts=(Part(ReleasedTarsSource(paths, split=split)),))
    return replace(FINETUNE, data=replace(FINETUNE.data, mixture=mixture))


def test_tars_are_known_by_their_own_names_and_not_by_the_folders(writes_nothing, tmp_path):
    folder = tmp_path / "ho3d_and_arctic" / "mine"
    folder.mkdir(parents=True)
    for name in ("DexYCB_mv_train-000000.tar", "Interhand_mv_val-000000.tar"):
        (folder / name).touch()
    for config in (
        on_tars(f"{folder}/DexYCB_mv_train-{{000000..000003}}.tar"),
        on_tars(f"{folder}/Dex*.tar"),
        on_tars(str(folder), split="train"),
    ):
        (part,) = smoke(config, tmp_path / "smoke").data.mixture.parts
        assert "/DexYCB_mv/DexYCB_mv_train-" in part.source.paths[0]


@pytest.mark.parametrize("name", ["ho3d.tar", "Ours_mv_train-000000.tar"])
def test_tars_of_no_known_set_are_named(name, writes_nothing, tmp_path):
    with pytest.raises(ValueError, match=f"a shard must be named .*; got {name}"):
        smoke(on_tars(f"{tmp_path}/dexycb/{name}"), tmp_path / "smoke")


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_likeness_trains(name, tmp_path):
    whole = open_experiment(name)
    assert int(train(smoke(whole, tmp_path)).step) == 2
    assert len(list(tmp_path.glob("run/panels/step_*.png"))) == (whole.train.panel_every > 0)
