"""The options of `poem train`: its own, and those of the experiment."""

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from poem_jax.cli.run import parse
from poem_jax.cli.train import Train, override
from poem_jax.experiments import open_experiment
from poem_jax.miniatures import captures

TINY, FINETUNE = open_experiment("tiny_synthetic"), open_experiment("finetune")
GUIDE = Path(__file__).resolve().parents[2] / "docs" / "training.md"


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


def test_the_experiment_is_turned_before_its_fields_are_given(tmp_path):
    command = parse(
        ["train", "finetune", "--init", "shipped", "--data", "a", "b", "--train.steps", "3", "--smoke"]
    )
    assert isinstance(command, Train)
    assert (command.init, [str(path) for path in command.data], command.smoke) == (
        "shipped",
        ["a", "b"],
        True,
    )
    assert command.overrides == ("--train.steps", "3")
    captures.write(tmp_path / "desk", frames=2)
    config = replace(command, data=(tmp_path / "desk",), smoke=False)._config()
    assert config.train.steps == 3
    assert config.data.mixture.parts[0].source.folders == (str(tmp_path / "desk"),)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (["--smoke", "--export", "x"], "give it neither --export nor hosts"),
        (["--smoke", "--hosts", "auto"], "give it neither --export nor hosts"),
        (["--hosts", "auto", "--num-hosts", "2"], "give one or the other"),
        (["--coordinator", "a:1"], "--num-hosts, --host-index is missing"),
        (["--mano", "x.pkl"], "--mano belongs to --data"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, what):
    with pytest.raises(ValueError, match=what):
        parse(["train", "v2_small_synthetic", *options]).run()


def test_fine_tuning_without_a_capture_asks_for_data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"on the capture in capture, .* give --data DIR"):
        parse(["train", "finetune"]).run()
    assert not list(tmp_path.iterdir())


def test_the_options_that_the_guide_to_fine_tuning_names_can_be_given():
    table = GUIDE.read_text().split("## Fine-tune on your own rig")[1].split("| change | option |")[1]
    rows = [row for row in table.split("\n\n")[0].splitlines() if "`" in row]
    assert len(rows) > 4
    for row in rows:
        options = row.split("`")[1]
        assert override(FINETUNE, shlex.split(options)) != FINETUNE, options


def test_help_of_an_experiment_lists_its_fields(capsys):
    with pytest.raises(SystemExit):
        override(TINY, parse(["train", "tiny_synthetic", "--help"]).overrides)
    assert "--train.max-minutes" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        parse(["train", "--help"])
    assert "EXPERIMENT" in capsys.readouterr().out
