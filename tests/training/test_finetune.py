"""An experiment turned to another model or other data."""

import json
from dataclasses import replace

import pytest

from poem_jax.experiments import open_experiment
from poem_jax.miniatures import captures
from poem_jax.mixture.config import CapturesSource, ReleasedTarsSource, SyntheticSource
from poem_jax.models.presets import PRESETS
from poem_jax.training import finetune
from poem_jax.training.config import config_json
from poem_jax.training.finetune import start_from, train_on
from poem_jax.training.recipes import recipe_of

FINETUNE = open_experiment("finetune")


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig") / "desk"
    captures.write(folder, frames=2)
    return folder


@pytest.mark.parametrize("name", PRESETS)
def test_every_model_can_be_fine_tuned(name, monkeypatch):
    """Such a config is whole: it passes its own rules."""
    model = PRESETS[name]
    monkeypatch.setattr(finetune, "read_config", lambda folder: model)
    config = start_from(FINETUNE, "somewhere")
    assert (config.model, config.train.init_from) == (model, "somewhere")
    assert config.loss is recipe_of(model).loss
    assert config.data.synthetic.crop.expand_ratio == config.data.mixture.recipe.box_ratio == model.crop.ratio
    assert config.data.mixture.pose == ("param" in name or "mano" in name)
    assert config.optimizer == FINETUNE.optimizer
    json.loads(config_json(config))


def test_the_shipped_model_is_fine_tuned_by_its_name():
    assert start_from(FINETUNE, "shipped") == FINETUNE


def test_a_folder_without_a_model_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"no checkpoint at {tmp_path}"):
        start_from(FINETUNE, str(tmp_path))


def test_captures_stand_in_for_data_sets_and_synthetic_ones_stay(rig):
    config = train_on(FINETUNE, [rig])
    own, drawn = config.data.mixture.parts
    assert own == replace(FINETUNE.data.mixture.parts[0], source=CapturesSource((str(rig),)))
    assert drawn == FINETUNE.data.mixture.parts[1]
    assert isinstance(drawn.source, SyntheticSource)
    assert [shape.num_views for shape in config.data.batches] == [4]


def test_batches_have_the_views_that_the_rig_has(rig, monkeypatch):
    open_source = CapturesSource.open

    def with_more(source):
        opened = open_source(source)
        opened.max_views = 11
        return opened

    monkeypatch.setattr(CapturesSource, "open", with_more)
    assert train_on(FINETUNE, [rig]).data.batches[0].num_views == 8


def test_other_data_share_the_weight_evenly(rig, tmp_path):
    tars = tmp_path / "DexYCB_mv_train-000000.tar"
    config = train_on(FINETUNE, [tars, rig])
    first, second, drawn = config.data.mixture.parts
    assert (first.source, second.source) == (CapturesSource((str(rig),)), ReleasedTarsSource((str(tars),)))
    assert first.weight == second.weight == 0.375
    assert drawn.weight == 0.25


def test_an_experiment_without_data_sets_is_refused(rig):
    with pytest.raises(ValueError, match=r"tiny_synthetic has none. Take one that has, such as `finetune`"):
        train_on(open_experiment("tiny_synthetic"), [rig])
