"""`poem eval --table` and `--dataset`, from arguments to files."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from poem_jax.cli import USAGE_ERROR, main
from poem_jax.miniatures import captures
from poem_jax.models.apply import init
from poem_jax.tables.all_tables import TABLES
from poem_jax.tables.table import Table
from poem_jax.weights.store import save
from tests.micro import MICRO


@pytest.fixture(autouse=True)
def _no_cache_in_the_home_folder(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "xla"))


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    captures.write(folder, frames=1)
    return folder


@pytest.mark.parametrize("name", [name for name, table in TABLES.items() if isinstance(table, Table)])
def test_a_table_without_its_data_writes_what_to_download(name, tmp_path, capsys) -> None:
    nowhere = ["--data-root", str(tmp_path / "data"), "--checkpoints", str(tmp_path / "weights")]
    assert main(["eval", "--table", name, "--out", str(tmp_path / "out"), *nowhere]) == 0
    printed = capsys.readouterr().out
    assert "## What is missing" in printed
    text = (tmp_path / "out" / f"{name}.md").read_text()
    assert str(tmp_path / "data") in text
    assert f"]({name}.png)" in text
    rows = json.loads((tmp_path / "out" / f"{name}.json").read_text())["rows"]
    assert any(row["paper"] for row in rows)
    assert (tmp_path / "out" / f"{name}.png").stat().st_size > 1000


def test_any_model_on_a_capture_whose_labels_are_joints_alone(capture, tmp_path, capsys) -> None:
    save(tmp_path / "ckpt", MICRO, init(MICRO, key=jax.random.key(0)))
    labels = dict(np.load(capture / "labels.npz"))
    labels = {name: labels[name] for name in ("hand_side", "frames", "joints_world")}
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("rig.json", "frames"):
        (alone / name).symlink_to(capture / name)
    np.savez(alone / "labels.npz", **labels)
    arguments = ["eval", "--dataset", str(alone), "--checkpoint", str(tmp_path / "ckpt"), "--no-progress"]
    arguments += ["--views", "3", "--batch-size", "1", "--json", str(tmp_path / "r.json")]
    assert main(arguments) == 0
    assert "joints alone are scored" in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "r.json").read_text())["rows"]
    assert row["samples"] == 1
    assert row["how"]["cameras"] == "the first 3"
    assert row["how"]["root"] == "the system's own"
    assert row["ours"]["mpjpe_mm"] > 0
    assert "mpvpe_mm" not in row["ours"]


def test_a_dataset_row_says_whose_root_it_was_and_counts_as_its_protocol_does(capture, tmp_path) -> None:
    save(tmp_path / "ckpt", MICRO, init(MICRO, key=jax.random.key(0)))
    file = tmp_path / "r.json"
    arguments = ["eval", "--dataset", str(capture), "--checkpoint", str(tmp_path / "ckpt"), "--no-progress"]
    arguments += ["--batch-size", "1", "--json", str(file)]
    for more, root, samples in (
        (["--views", "1"], "the true one", 1),  # one view does not fix it
        (["--views", "3", "--given-root"], "the true one", 1),
        (["--views", "3", "--protocol", "ho3d"], "the system's own", 3),  # every image counts
    ):
        assert main([*arguments, *more]) == 0
        (row,) = json.loads(file.read_text())["rows"]
        assert (row["how"]["root"], row["samples"]) == (root, samples)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "say one of EXPERIMENT, --table NAME and --dataset PATH; got none"),
        (["tiny_synthetic", "--table", "main"], "got tiny_synthetic, main"),
        (["--table", "nothing"], "--table must be one of main, ablation, robustness, v2, ho3d-v2"),
        (["--table", "main", "--dataset", "x"], "--dataset goes with --table real-world"),
        (
            ["--table", "main", "--checkpoint", "x", "--given-root"],
            "--checkpoint, --given-root: leave it out",
        ),
        (["--dataset", "x", "--stages"], "--dataset does not go with --stages"),
        (["tiny_synthetic", "--mano", "x"], "EXPERIMENT does not go with --mano"),
        (["--dataset", "nowhere"], "nothing that could be a data set at nowhere"),
        (["--dataset", "nowhere", "--views", "two"], "cameras are `all`"),
    ],
)
def test_bad_arguments_end_with_a_message(arguments, message, capsys) -> None:
    assert main(["eval", *arguments]) == USAGE_ERROR
    assert message in capsys.readouterr().err
