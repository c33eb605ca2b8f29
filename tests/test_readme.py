"""What the README and the documents promise: no blanks, no dead links, commands and code that work."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from poem_jax import preset
from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.models.poem_v1_config import one_stage
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.weights.store import shipped

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
DOCUMENTS = [README, *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
PLACEHOLDER = re.compile(r"@[A-Z][A-Z0-9_]*@")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_no_number_is_left_blank(document: Path) -> None:
    assert PLACEHOLDER.findall(document.read_text()) == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_linked_files_and_pictures_exist(document: Path) -> None:
    targets = [t.split("#")[0] for t in LINK.findall(document.read_text()) if "://" not in t]
    assert [t for t in targets if t and not (document.parent / t).exists()] == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_linked_sections_exist(document: Path) -> None:
    titles = re.findall(r"^#+ (.+)$", document.read_text(), re.MULTILINE)
    sections = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
    assert [t for t in LINK.findall(document.read_text()) if t[0] == "#" and t[1:] not in sections] == []


def test_commands_of_the_readme_are_targets_of_make() -> None:
    commands = set(re.findall(r"(?:^|`)make ([a-z][a-z-]*)", README.read_text(), re.MULTILINE))
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {"demo", "test"} <= commands
    assert commands <= targets


def test_the_code_of_the_readme_runs_anywhere_and_reconstructs_a_hand(tmp_path) -> None:
    """In a process that sees the package and nothing else of the checkout."""
    (tmp_path / "poem_jax").symlink_to(ROOT / "poem_jax")
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert 5 <= len(code.strip().splitlines()) <= 12
    environment = {**os.environ, "PYTHONPATH": ""}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    error, unit = done.stdout.split()
    assert unit == "mm"
    assert 0 < float(error) < 30


def test_the_code_of_the_models_page_makes_an_experiment_and_a_mean_root() -> None:
    page = (ROOT / "docs" / "models.md").read_text()
    experiment, mean = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict = {}
    exec(compile(experiment, "docs/models.md", "exec"), names)
    assert names["config"].model == preset("v1")
    assert names["config"].loss.name == "v1"
    assert "range(100)" in mean
    exec(compile(mean.replace("range(100)", "range(1)"), "docs/models.md", "exec"), names)
    assert 0.3 < names["origin"][2] < 1.5
    assert names["model"] == one_stage(names["origin"])


def test_the_code_of_the_geometry_page_triangulates_and_reconstructs_from_photographs() -> None:
    page = (ROOT / "docs" / "geometry.md").read_text()
    gradient, crops = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict = {}
    exec(compile(gradient, "docs/geometry.md", "exec"), names)
    assert bool(names["valid"].all())
    np.testing.assert_allclose(names["found"], names["point"], atol=1e-5)
    # Depth by disparity: Z^2 / (f b).
    slope = abs(names["metres_per_pixel"][0, 2, 1, 0, 0])
    np.testing.assert_allclose(slope, 0.7**2 / (900 * 0.2), rtol=0.05)
    exec(compile(crops, "docs/geometry.md", "exec"), names)
    config, params = shipped()
    sample = SyntheticDataset(replace(benchmark, image_hw=(256, 256)), seed=9)[0]
    points = sample.keypoints_px
    boxes = np.concatenate([points.min(1), points.max(1)], -1).astype(np.float64)
    K, T, _ = sample.cameras
    hand = names["reconstruct"](sample.views, K.astype(np.float64), T, boxes, config, params)
    assert 1000 * np.linalg.norm(hand.vertices_world[0] - sample.vertices_world, axis=-1).mean() < 12
