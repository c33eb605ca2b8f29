"""The options of `poem train`: its own, and those of the experiment."""

from dataclasses import replace

import pytest

from poem_jax.cli.run import parse
from poem_jax.cli.train import Train, override
from poem_jax.experiments import open_experiment

TINY = open_experiment("tiny_synthetic")


def test_overrides_are_typed_and_unknown_ones_fail():
    arguments = ["--train.max-minutes", "1.5", "--loss.layers", "last", "--model.width", "32"]
    changed = override(TINY, arguments)
    assert (changed.train.max_minutes, changed.loss.layers.value, changed.model.width) == (1.5, "last", 32)
    assert override(TINY, []) == TINY
    for wrong in (["--train.stepz", "3"], ["--train.steps", "many"]):
        with pytest.raises(SystemExit) as stop:
            override(TINY, wrong)
        assert stop.value.code == 2


def test_what_is_not_an_option_of_train_goes_to_the_experiment(tmp_path):
    command = parse(["train", "tiny_synthetic", "--train.steps", "3", "--export", "x", "--debug"])
    assert isinstance(command, Train)
    assert command.overrides == ("--train.steps", "3")
    assert command.debug
    assert str(command.export) == "x"
    assert override(TINY, command.overrides) == replace(TINY, train=replace(TINY.train, steps=3))


def test_help_of_an_experiment_lists_its_fields(capsys):
    with pytest.raises(SystemExit):
        override(TINY, parse(["train", "tiny_synthetic", "--help"]).overrides)
    assert "--train.max-minutes" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        parse(["train", "--help"])
    assert "EXPERIMENT" in capsys.readouterr().out
