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
import numpy as np
from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints, write_boxes
from poem_jax.capture.demo import demo_folder, demo_truth
from poem_jax.data.capture_folder import find_rig
from poem_jax.data.lens import project_raw

rig, truth = find_rig(demo_folder()), demo_truth()
hands = truth.joints_world[0]
keypoints = np.array([[project_raw(rig, v, hand)[0] for v in range(4)] for hand in hands])[None]
write_boxes("keypoints.npz", HandBoxes(boxes_from_keypoints(keypoints), truth.sides, None, keypoints))
write_rig("rig.json", rig)
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
    """Videos and a calibration file in, both hands out, as far from the truth as the README says."""
    (promised,) = re.findall(r"\*\*MPVPE (\d+\.\d) mm\*\*", (ROOT / "README.md").read_text())
    printed = run("poem", "demo")
    (error, found) = re.findall(r"MPVPE (\d+\.\d) mm, .* over (\d+) of 90 hands", printed)[0]
    assert float(error) == pytest.approx(float(promised), abs=0.2)
    assert int(found) >= 88
    for name in ("index.html", "hands.glb", "prediction.npz", "report.json"):
        assert (tmp_path / "out" / "demo" / name).is_file()


def test_fit(run, tmp_path):
    run("python", "-c", MAKE_KEYPOINTS)

    assert "2 of 2 hands in 1 frames" in run("poem", "fit", "keypoints.npz", "--out", "out")
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
