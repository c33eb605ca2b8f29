"""`poem`: help, the demo, a reconstruction, and one clear line for wrong input."""

import json
import subprocess
import sys

import numpy as np
import pytest

from poem_jax.cli import USAGE_ERROR, main
from tests.one_hand.capture import one_hand_folder


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Whatever the command sets for its process ends with the test."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory, micro_model):
    from poem_jax.weights.store import save

    path = tmp_path_factory.mktemp("weights") / "micro"
    save(path, *micro_model)
    return path


def test_reconstruct(tmp_path, capsys, checkpoint):
    out = tmp_path / "out"
    rig, boxes = one_hand_folder() / "rig.json", one_hand_folder() / "boxes.npz"
    command = [
        "reconstruct",
        str(one_hand_folder()),
        "--rig",
        str(rig),
        "--boxes",
        str(boxes),
        "--out",
        str(out),
    ]
    assert main([*command, "--checkpoint", str(checkpoint)]) == 0
    assert "1 of 1 hands in 1 frames" in capsys.readouterr().out
    with np.load(out / "prediction.npz") as arrays:
        assert arrays["vertices_world"].shape == (1, 1, 778, 3)
    report = json.loads((out / "report.json").read_text())
    assert report["weights"] == str(checkpoint)
    assert "poem_jax" in report["versions"]


@pytest.mark.parametrize(
    ("empty", "what"),
    [(("--out", ""), "an empty argument after '--out'"), (("--out=",), "nothing after '--out='")],
)
def test_an_empty_option_is_not_the_folder_that_one_is_in(tmp_path, monkeypatch, capsys, empty, what):
    monkeypatch.chdir(tmp_path)
    assert main(["reconstruct", str(one_hand_folder()), *empty]) == USAGE_ERROR
    assert capsys.readouterr().err == f"poem: error: {what}: is a shell variable unset?\n"
    assert not list(tmp_path.iterdir())


def test_a_value_may_end_in_a_sign_of_equality(tmp_path, capsys):
    assert main(["reconstruct", str(tmp_path / "none"), f"--out={tmp_path}/run="]) == USAGE_ERROR
    assert "unset" not in capsys.readouterr().err


def test_wrong_input_is_one_line_and_code_2(tmp_path, capsys, checkpoint):
    command = ["reconstruct", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]
    assert main(command) == USAGE_ERROR == 2
    error = capsys.readouterr().err
    assert error.startswith("poem: error: no capture folder at")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
    with pytest.raises(FileNotFoundError, match="no capture folder"):
        main([*command, "--debug"])
    no_model = ["reconstruct", str(one_hand_folder()), "--out", str(tmp_path / "out"), "--checkpoint"]
    assert main([*no_model, str(tmp_path / "none")]) == USAGE_ERROR
    assert "no checkpoint at" in capsys.readouterr().err


def test_an_error_of_the_system_is_one_line_too(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    command = ["demo", "--out"]
    assert main([*command, str(tmp_path / "file")]) == USAGE_ERROR
    assert "the results go to a folder" in capsys.readouterr().err
    assert main([*command, str(tmp_path / ("x" * 300))]) == USAGE_ERROR
    error = capsys.readouterr().err
    assert "File name too long" in error
    assert error.count("\n") == 1


def test_help_is_quick_and_names_the_commands():
    code = """
import sys
from poem_jax.cli import main
try:
    main(["--help"])
except SystemExit:
    assert "jax" not in sys.modules, "help must not import JAX"
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "demo" in done.stdout
    assert "reconstruct" in done.stdout


def test_unknown_commands_are_usage_errors(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["reconstrct"])
    assert stop.value.code == USAGE_ERROR
