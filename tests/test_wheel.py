"""The wheel, installed into an environment of its own and used outside the checkout, as a user would."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("poem_jax", "pyproject.toml", "README.md", "LICENSE")
MAKE_KEYPOINTS = """
import shutil
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints, write_boxes
from poem_jax.capture.demo import demo_folder, ground_truth
from poem_jax.calibration.rig_json import read_rig
from poem_jax.geometry.cameras import project

rig = read_rig(demo_folder() / "rig.json")
vertices, joints = ground_truth()
keypoints = project(rig.K, rig.T_cam_from_world, joints[0])[0][None, None]
write_boxes("keypoints.npz", HandBoxes(boxes_from_keypoints(keypoints), ("right",), None, keypoints))
shutil.copy(demo_folder() / "rig.json", ".")
"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The folder of programs of a fresh environment that holds the wheel.

    The dependencies are those of the running interpreter, added by a path file. Path files in there are not
    read, so that an editable install of the checkout stays out of sight.
    """
    folder = tmp_path_factory.mktemp("wheel")
    sources, environment = folder / "sources", folder / "env"
    # A copy: building leaves folders behind, and takes up what stands in them from before.
    sources.mkdir()
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, sources / name)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", folder, sources], check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    (wheel,) = folder.glob("*.whl")
    python = environment / "bin" / "python"
    subprocess.run([*pip, "--python", python, "install", "--no-deps", "--no-index", wheel], check=True)
    (site,) = environment.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return environment / "bin"


@pytest.fixture
def run(installed, tmp_path):
    """Run a program of the environment in an empty folder; return what it prints."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "XLA_FLAGS", "PJRT_NPROC")}

    def run(*command: str) -> str:
        line = [str(installed / command[0]), *command[1:]]
        done = subprocess.run(line, cwd=tmp_path, env=kept, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_what_is_imported_is_the_wheel(run, installed):
    place = run("python", "-c", "import poem_jax; print(poem_jax.__file__)").strip()
    assert Path(place).is_relative_to(installed.parent)


def test_the_example_of_the_readme(run):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    error, unit = run("python", "-c", code).split()
    assert unit == "mm"
    (promised,) = re.findall(r"# (\d+\.\d);", code)
    assert float(error) == pytest.approx(float(promised), abs=0.1)


def test_demo(run, tmp_path):
    (promised,) = re.findall(r"\*\*MPVPE (\d+\.\d) mm\*\*", (ROOT / "README.md").read_text())
    assert f"MPVPE {promised} mm" in run("poem", "demo")
    assert (tmp_path / "out" / "demo" / "index.html").is_file()


def test_fit(run, tmp_path):
    run("python", "-c", MAKE_KEYPOINTS)

    assert "1 of 1 hands in 1 frames" in run("poem", "fit", "keypoints.npz", "--out", "out")
    assert (tmp_path / "out" / "prediction.npz").is_file()


def test_images_and_a_rig_are_all_that_is_needed(run, shared_dir, tmp_path):
    """Detection, association, fit and page, in one command, with real photographs."""
    take = shared_dir / "data" / "caliscope_4cam_hands"
    assert "24 of 24 hands in 12 frames" in run("poem", "fit", str(take), "--out", "out")
    for name in ("keypoints.npz", "prediction.npz", "index.html"):
        assert (tmp_path / "out" / name).is_file()


def test_train_three_steps_and_go_on(run, tmp_path):
    options = ("--train.host-devices", "1", "--train.log-every", "1", "--train.checkpoint-every", "2")
    small = ("--data.batches.0.batch-size", "2", "--data.batches.1.batch-size", "2")
    small += ("--data.batches.2.batch-size", "2", "--train.validate-every", "0")
    assert "step 3 of 3" in run("poem", "train", "tiny_synthetic", "--train.steps", "3", *options, *small)
    lines = (tmp_path / "runs" / "tiny_synthetic" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2, 3]
