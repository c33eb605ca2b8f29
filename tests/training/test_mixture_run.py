"""A run whose samples come from a mixture: it learns in sittings, and knows the files that it began with."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from poem_jax.data.augmentation_recipes import PAPER, RELEASE_V1, RELEASE_V2
from poem_jax.data.loader import draw_ahead
from poem_jax.data.view_sampling import AllViews, UniformViews
from poem_jax.mixture.config import CapturesSource, MixtureConfig, Part, SyntheticSource
from poem_jax.mixture.stream import MixtureStream
from poem_jax.training.config import BatchShape, config_json, differences, flatten_config
from poem_jax.training.loop import train
from poem_jax.training.source import (
    drawing_threads,
    mixture_batches,
    open_training_data,
    training_batches,
)
from tests.mixture.fake_frames import FakeFrames


@pytest.fixture(autouse=True)
def one_device(monkeypatch):
    devices = jax.devices()[:1]
    monkeypatch.setattr(jax, "devices", lambda *_: devices)


@pytest.fixture
def in_memory(monkeypatch):
    """Captures come from no folder; its name is what identifies their file."""
    monkeypatch.setattr(CapturesSource, "open", lambda source: FakeFrames(stamp=source.folders[0]))


@pytest.fixture
def config(micro_config):
    mixture = MixtureConfig(
        parts=(
            Part(CapturesSource(("1",)), 0.75, UniformViews()),
            Part(SyntheticSource(), 0.25, AllViews()),
        ),
        processes=0,
    )
    data = replace(micro_config.data, mixture=mixture, workers=2, batches=(BatchShape(3, 4),))
    return replace(micro_config, data=data)


def test_a_batch_depends_on_the_step_alone_and_hosts_share_it(config, in_memory, tmp_path):
    with training_batches(config, open_training_data(config), begun=False) as batch_at:
        batches = {step: batch_at(step) for step in (3, 0, 5)}
    mixture = open_training_data(config)
    with training_batches(config, mixture, begun=True) as batch_at:
        for step, batch in batches.items():
            jax.tree.map(np.testing.assert_array_equal, batch_at(step), batch)
            assert batch.views.shape == (4, 3, 32, 32, 3)
            assert batch.cameras.view_mask.any(1).all()
    with MixtureStream(mixture, processes=0, run_dir=tmp_path, max_corrupt_share=0.0) as stream:
        halves = [mixture_batches(config.data, stream, host=h, hosts=2)(3) for h in range(2)]
    together = jax.tree.map(lambda *rows: np.concatenate(rows), *halves)
    jax.tree.map(np.testing.assert_array_equal, together, batches[3])


def test_a_process_draws_the_same_batches(config, in_memory):
    batches = {}
    for each in (config, drawn_by_a_process(config)):
        with training_batches(each, open_training_data(each), begun=False) as batch_at:
            ahead = draw_ahead(batch_at, 1, ahead=2, workers=drawing_threads(each.data))
            batches[each.data.mixture.processes] = [next(ahead) for _ in range(2)]
            ahead.close()
    jax.tree.map(np.testing.assert_array_equal, batches[0], batches[1])


def drawn_by_a_process(config):
    return replace(config, data=replace(config.data, mixture=replace(config.data.mixture, processes=1)))


@pytest.mark.parametrize("recipe", [PAPER, RELEASE_V1, RELEASE_V2])
def test_the_config_of_a_run_can_be_read_back(config, recipe):
    """A run that could not read its own config could not go on."""
    data = replace(config.data, mixture=replace(config.data.mixture, recipe=recipe))
    written = config_json(replace(config, data=data))
    json.loads(written, parse_constant=pytest.fail)


def test_processes_are_given_two_batches_at_a_time(config):
    one = replace(config.data, workers=1)
    assert drawing_threads(one) == 1
    assert drawing_threads(replace(one, mixture=replace(one.mixture, processes=2))) == 2
    assert drawing_threads(replace(one, mixture=None)) == 1
    assert drawing_threads(replace(one, workers=3, mixture=replace(one.mixture, processes=2))) == 3


def test_a_run_from_a_mixture_goes_on_and_refuses_other_files(config, in_memory):
    run = Path(config.train.out)
    first = replace(config, train=replace(config.train, steps=2))
    assert int(train(drawn_by_a_process(first)).step) == 2
    assert list(json.loads((run / "data_files.json").read_text()).values()) == [{"fake.tar": "1"}, {}]
    (entry,) = json.loads((run / "data_report.json").read_text())
    assert {"fake train", "synthetic captures"} == entry["sources"].keys()

    parts = config.data.mixture.parts
    other = (replace(parts[0], source=CapturesSource(("2",))), parts[1])
    changed = replace(config, data=replace(config.data, mixture=replace(config.data.mixture, parts=other)))
    changed = replace(changed, train=replace(changed.train, steps=2))
    with pytest.raises(ValueError, match="holds a run of another config"):
        train(changed)
    (run / "data_files.json").write_text('{"fake train": {"fake.tar": "0"}, "synthetic captures": {}}')
    with pytest.raises(ValueError, match=r"fake train: fake.tar: 0 -> 1.*allow-config-change"):
        train(first)
    allowed = replace(first, train=replace(first.train, allow_config_change=True))
    assert int(train(allowed).step) == 2

    (run / "data_files.json").unlink()
    with pytest.raises(ValueError, match=r"data_files.json is gone"):
        train(first)


def test_missing_data_leave_no_run_behind(config, tmp_path):
    parts = (Part(CapturesSource((str(tmp_path / "absent"),))),)
    mixture = replace(config.data.mixture, parts=parts)
    with pytest.raises(FileNotFoundError, match="absent"):
        train(replace(config, data=replace(config.data, mixture=mixture)))
    assert not Path(config.train.out).exists() or not any(Path(config.train.out).iterdir())


def test_rules_of_a_run_from_a_mixture(config):
    data = config.data
    with pytest.raises(ValueError, match=r"`min_views` of `data.batches` is for synthetic captures alone"):
        replace(data, batches=(BatchShape(3, 4, min_views=1),))
    recipe = replace(data.mixture.recipe, box_ratio=1.5)
    with pytest.raises(ValueError, match=r"must be the model's `crop.ratio`, 2.0; got 1.5"):
        replace(config, data=replace(data, mixture=replace(data.mixture, recipe=recipe)))
    more = replace(
        config, data=replace(data, mixture=replace(data.mixture, processes=9, max_corrupt_share=1.0))
    )
    assert differences(flatten_config(config), flatten_config(more)) == []
