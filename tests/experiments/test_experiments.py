"""Experiments: those of the package by name, others by path, and the doors in `configs/`."""

import importlib
from dataclasses import replace
from pathlib import Path

import pytest

from poem_jax import experiments
from poem_jax.experiments import experiment_names, open_experiment
from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.models.presets import PRESETS
from poem_jax.training.config import Schedule, TrainConfig

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(experiments.__file__).parent


def configs_of(name: str) -> dict[str, TrainConfig]:
    return getattr(importlib.import_module(f"poem_jax.experiments.{name}"), "configs", {})


@pytest.mark.parametrize("name", experiment_names())
def test_every_experiment_opens_by_name_and_says_what_to_expect(name):
    config = open_experiment(name)
    assert config.name == name
    assert config.train.out == f"runs/{name}"
    document = importlib.import_module(f"poem_jax.experiments.{name}").__doc__
    assert document is not None
    for part in ("What:", "Hardware:", "Time:", "Expected:", f"Command:   poem train {name}\n"):
        assert part in document


@pytest.mark.parametrize("name", [*experiment_names(), "synthetic_benchmark"])
def test_configs_has_a_door_to_every_experiment(name):
    door = importlib.util.spec_from_file_location(f"door_{name}", ROOT / "configs" / f"{name}.py")
    module = importlib.util.module_from_spec(door)
    door.loader.exec_module(module)
    variable = "benchmark" if name == "synthetic_benchmark" else "config"
    there = importlib.import_module(f"poem_jax.experiments.{name}")
    assert getattr(module, variable) is getattr(there, variable)


@pytest.mark.parametrize("name", [name for name in experiment_names() if configs_of(name)])
def test_each_of_several_experiments_opens_behind_a_colon_and_keeps_to_its_own_folder(name):
    several = configs_of(name)
    opened = [open_experiment(f"{name}:{which}") for which in several]
    assert opened == list(several.values())
    folders = [config.train.out for config in (*opened, open_experiment(name))]
    assert len(set(folders)) == len(folders)
    assert all(config.train.out == f"runs/{config.name}" for config in opened)
    assert open_experiment(f"{ROOT}/configs/{name}.py:{next(iter(several))}") == opened[0]


def test_released_recipes_of_one_set_drop_the_rate_after_the_same_epoch():
    """Whether 100 or 101 epochs follow."""
    for which, config in configs_of("v1_release").items():
        model, _, dataset = which.rpartition("-")
        epochs = 100 if which == "pe-meshtr-dexycb" else 101
        assert config.train.steps % epochs == 0
        drop = config.optimizer.drop_at * epochs
        assert drop == pytest.approx(32 if model == "ftl-meshtr" else 70), (which, dataset)


def test_every_released_model_of_poem_v2_has_its_recipe_on_the_six_sets():
    medium, others = open_experiment("v2_medium_six_sets"), configs_of("v2_medium_six_sets")
    released = {name for name in PRESETS if name.startswith("v2-") and name.endswith("-release")}
    assert others.keys() | {"v2-medium-release"} == released
    assert medium.model == PRESETS["v2-medium-release"]
    assert medium.optimizer.schedule is Schedule.STEP
    for name, config in others.items():
        assert config.model == PRESETS[name]
        parametric = "mano" in name
        assert config.data.mixture.pose == parametric
        schedule = Schedule.COSINE if parametric else Schedule.STEP
        assert config.optimizer == replace(medium.optimizer, schedule=schedule)
        assert (config.loss, config.training_root) == (medium.loss, medium.training_root)
        views = [[part.views for part in of.data.mixture.parts] for of in (config, medium)]
        assert views[0] == views[1]


def test_configs_has_no_door_to_nothing():
    doors = {path.stem for path in (ROOT / "configs").glob("*.py")}
    assert doors == {path.stem for path in FOLDER.glob("*.py")} - {"__init__"}


def test_an_experiment_opens_by_path(tmp_path):
    mine = tmp_path / "mine.py"
    mine.write_text(
        "from dataclasses import replace\n"
        "from poem_jax.experiments.tiny_synthetic import config as tiny\n"
        "config = replace(tiny, name='mine')\n"
    )
    assert open_experiment(mine).name == open_experiment(str(mine)).name == "mine"
    assert open_experiment(ROOT / "configs" / "tiny_synthetic.py") == open_experiment("tiny_synthetic")


def test_what_cannot_be_opened_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"no experiment is called 'tinny'; the package has .*tiny_syn"):
        open_experiment("tinny")
    with pytest.raises(ValueError, match="no experiment is called 'synthetic_benchmark'"):
        open_experiment("synthetic_benchmark")
    with pytest.raises(
        ValueError, match="no experiment is called v1_paper:v3; v1_paper has v1-dexycb, v1-oak"
    ):
        open_experiment("v1_paper:v3")
    with pytest.raises(ValueError, match="tiny_synthetic:v3; tiny_synthetic is one experiment"):
        open_experiment("tiny_synthetic:v3")
    with pytest.raises(FileNotFoundError, match=r"experiment file not found: .*absent\.py"):
        open_experiment(str(tmp_path / "absent.py"))
    with pytest.raises(FileNotFoundError, match=r"experiment file not found: absent\.py"):
        open_experiment("absent.py")
    (tmp_path / "empty.py").write_text("other = 1\n")
    with pytest.raises(ValueError, match=r"must define `config = TrainConfig.*it defines \['other'\]"):
        open_experiment(tmp_path / "empty.py")
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(ValueError, match="is not a Python file"):
        open_experiment(tmp_path / "notes.txt")


def test_the_benchmark_is_what_the_shipped_model_learned_from():
    assert open_experiment("tiny_synthetic").data.synthetic == benchmark
