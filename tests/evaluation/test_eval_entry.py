"""`poem eval` from experiment file to JSON, with a model too small to be good."""

import json
from pathlib import Path
from typing import get_args, get_type_hints

import jax
import numpy as np
import pytest

from poem_jax.cli import USAGE_ERROR, main
from poem_jax.cli.evaluate import Eval, captures_config
from poem_jax.evaluation.benchmark import DEFAULT_SEED
from poem_jax.evaluation.protocols import PROTOCOLS
from poem_jax.experiments import open_experiment
from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.models.apply import init
from poem_jax.weights.store import save

EXPERIMENT = """
import dataclasses
from poem_jax.models.config import BasisConfig, ResNetConfig
from poem_jax.models.presets import TINY
from poem_jax.training.config import DataConfig, TrainConfig
from poem_jax.synthetic.config import SyntheticConfig

model = dataclasses.replace(
    TINY,
    image_hw=(32, 32),
    width=16,
    backbone=dataclasses.replace(
        TINY.backbone, blocks=(1, 1, 1, 1), channels=(8, 8, 16, 16), stem_channels=8
    ),
    basis=BasisConfig(num_points=64),
    decoder=dataclasses.replace(TINY.decoder, num_layers=1, num_neighbours=4),
)
data = DataConfig(synthetic=SyntheticConfig(image_hw=(32, 32), num_backgrounds=2))
config = TrainConfig(name="mini", model=model, data=data)
"""


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> tuple[Path, Path]:
    """Experiment file and checkpoint."""
    folder = tmp_path_factory.mktemp("mini")
    file = folder / "mini.py"
    file.write_text(EXPERIMENT)
    config = open_experiment(file).model
    save(folder / "ckpt", config, init(config, key=jax.random.key(0)))
    return file, folder / "ckpt"


@pytest.fixture(autouse=True)
def _no_cache_in_the_home_folder(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "xla"))


def test_prints_the_tables_and_writes_json_by_view_count(experiment, tmp_path, capsys) -> None:
    file, checkpoint = experiment
    path = tmp_path / "r.json"
    arguments = ["eval", str(file), "--checkpoint", str(checkpoint), "--views", "1,2", "--samples", "3"]
    arguments += ["--batch-size", "2", "--seed", "5", "--json", str(path), "--no-progress"]
    assert main(arguments) == 0
    results = json.loads(path.read_text())
    assert list(results) == ["1", "2"]
    for scores in results.values():
        assert {"mpvpe_mm", "median_mpvpe_mm", "mpvpe_true_root_mm", "f_5", "auc_j_20"} <= set(scores)
        assert scores["samples"] == 3
    assert results["1"]["root_error_mm"] == pytest.approx(0, abs=1e-3)
    # One prediction, averaged in two orders.
    assert results["1"]["mpvpe_mm"] == pytest.approx(results["1"]["mpvpe_true_root_mm"], rel=1e-12)
    assert results["1"]["mean_pose_mpvpe_mm"] == results["2"]["mean_pose_mpvpe_mm"]
    assert np.isfinite(results["2"]["root_error_mm"])
    assert results["1"]["fit_mpvpe_mm"] is None
    assert np.isfinite(results["2"]["fit_mpvpe_mm"])
    assert 0 <= results["2"]["fit_unsolved"] <= 3
    printed = capsys.readouterr().out
    for part in ("MPVPE", "AUC-J@20", "F@15", "mean pose", "3 synthetic captures of seed 5", str(checkpoint)):
        assert part in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--views", "0"], "`views` must name counts from 1 to 8; got (0,)"),
        (["--samples", "0"], "`samples` and `batch_size` must be at least 1"),
        (["--seed", "-1"], "`seed` must not be negative"),
        (["--checkpoint", "nowhere"], "no checkpoint at nowhere"),
        (["--stages", "--views", "1"], "--stages needs a view count of 2 or more"),
        (["--stages", "--samples", "4"], "got --views 1,2,4,8, --samples 4, --batch-size 8"),
        (["--stages", "--batch-size", "1"], "at least one batch of 2 or more"),
    ],
)
def test_bad_arguments_end_with_a_message(experiment, capsys, arguments, message) -> None:
    file, checkpoint = experiment
    assert main(["eval", str(file), "--checkpoint", str(checkpoint), *arguments]) == USAGE_ERROR
    assert message in capsys.readouterr().err


def test_a_checkpoint_of_another_config_is_refused(experiment, tmp_path, capsys) -> None:
    _, checkpoint = experiment
    other = tmp_path / "other.py"
    other.write_text(EXPERIMENT.replace("num_points=64", "num_points=32"))
    assert main(["eval", str(other), "--checkpoint", str(checkpoint)]) == USAGE_ERROR
    assert "checkpoint of another config" in capsys.readouterr().err


def test_a_missing_experiment_is_named(capsys) -> None:
    assert main(["eval", "configs/nothing.py"]) == USAGE_ERROR
    assert "experiment file not found" in capsys.readouterr().err


def test_views_that_are_no_numbers(capsys) -> None:
    assert main(["eval", "configs/tiny_synthetic.py", "--views", "two"]) == USAGE_ERROR
    assert "expected view counts such as 2,4,8; got 'two'" in capsys.readouterr().err


def test_the_table_of_the_shipped_model_is_of_the_fixed_benchmark() -> None:
    config = open_experiment("tiny_synthetic")
    assert captures_config(config) == benchmark
    assert config.data.seed != DEFAULT_SEED


def test_options_of_the_command_are_those_of_the_benchmark() -> None:
    options = get_type_hints(Eval)
    assert Eval("tiny_synthetic").seed == DEFAULT_SEED
    assert set(get_args(options["protocol"])) == set(PROTOCOLS)
