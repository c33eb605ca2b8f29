"""Every array and number that the two releases stored is compared somewhere, or named as not built yet.

The tables in question are those that the tests themselves run over. The metrics of POEM v2 have no table:
their tests run here once more, and tell which keys they read. What nothing compares yet is listed by name, so
that a new file, and a new array of a file that is used, are noticed.
"""

import fnmatch
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from poem_jax.evaluation.metrics import evaluate, mean_error, point_distances
from tests.data import test_crops_golden
from tests.evaluation import test_metrics_golden
from tests.weights import (
    test_release_parity,
    test_release_stages,
    test_release_training,
    test_v1_import,
    test_v1_mesh_parity,
    test_v1_mvp_parity,
    test_v1_poem_parity,
)
from tests.weights.procedural import REFERENCE, needs_reference

pytestmark = needs_reference

STAGE_FILES = {file for file, _, _ in test_release_stages.COMPARED}
TRAINING = f"golden_{test_release_training.FILE}"
METRICS = "golden_metrics"


def stored_keys(name: str) -> set[str]:
    """List the keys of the `.npz` and the `.json` of that name, which share none."""
    with np.load(REFERENCE / f"{name}.npz") as arrays:
        keys = list(arrays.files)
    numbers = REFERENCE / f"{name}.json"
    if numbers.is_file():
        keys += json.loads(numbers.read_text())
    assert len(keys) == len(set(keys))
    return set(keys)


def compared_keys(name: str) -> set[str]:
    keys = {key for case, key, _ in test_release_parity.COMPARED if f"golden_{case}" == name}
    keys |= {key for file, key, _ in test_release_stages.COMPARED if f"golden_{file}" == name}
    return keys | (set(test_release_training.COMPARED) if name == TRAINING else set())


def golden_names() -> list[str]:
    return sorted({path.stem for path in REFERENCE.glob("golden_*")})


def test_all_files_are_known() -> None:
    known = {f"golden_{case}" for case in test_release_parity.CASES} | {f"golden_{f}" for f in STAGE_FILES}
    assert set(golden_names()) == known | {TRAINING, METRICS}


@pytest.mark.parametrize("name", [name for name in golden_names() if name != METRICS])
def test_every_stored_key_is_compared(name: str) -> None:
    assert compared_keys(name) == stored_keys(name)


class Heard(dict):
    """A dictionary that notes which of its keys are read."""

    def __init__(self, content: dict[str, Any], read: set[str]) -> None:
        super().__init__(content)
        self.read = read

    def __getitem__(self, key: str) -> Any:
        self.read.add(key)
        return super().__getitem__(key)


def metric_tests() -> list[Callable[[], None]]:
    """List the tests of the metrics that compare with the release's own run."""
    functions = [f for name, f in vars(test_metrics_golden).items() if name.startswith("test_")]
    return [f for f in functions if "release" in f.__code__.co_names]


@pytest.mark.parity
def test_every_metric_of_the_release_is_compared(monkeypatch) -> None:
    read: set[str] = set()
    arrays, numbers = test_metrics_golden.release()
    monkeypatch.setattr(test_metrics_golden, "release", lambda: (Heard(arrays, read), Heard(numbers, read)))
    for test in metric_tests():
        test()
    assert read | set(OTHER_METRICS) == stored_keys(METRICS)
    assert read.isdisjoint(OTHER_METRICS)


OTHER_METRICS = ("MPVPE", "EPE_J_20mm", "EPE_J_50mm")


def test_metrics_that_are_stored_twice() -> None:
    """The mean errors of the two evaluators of the areas, which do not depend on their largest threshold."""
    arrays, numbers = test_metrics_golden.release()
    joints = mean_error(point_distances(arrays["pred_joints"], arrays["gt_joints"]))
    points = [arrays[key] for key in ("pred_joints", "gt_joints", "pred_verts", "gt_verts")]
    vertices_mm = evaluate(*points, protocol="poem")["mpvpe_mm"]
    ours = {"MPVPE": vertices_mm / 1000, "EPE_J_20mm": joints, "EPE_J_50mm": joints}
    assert set(ours) == set(OTHER_METRICS)
    for name, value in ours.items():
        np.testing.assert_allclose(value, numbers[name], rtol=1e-6, err_msg=name)


V1 = REFERENCE.parent / "poem_v1"
V1_USED = {"fake_mano.npz", "golden_fit.npz", "golden_transform_metrics.npz", "FACTS_v1.md"}
V1_NETWORKS = {"poem", "poem_g", "poem_gv", "poem_full", "poem_woproj", "petr", "ftl", "mvp4", "mvp8"}
V1_INPUTS = {"inputs_a.npz", "inputs_b.npz", "metrics.json", "float32_noise.json"}
"""Of the runs of the networks; the last holds what the goldens themselves are worth."""
V1_INPUT_SETS = {"mvp4": "a", "mvp8": "b"}
"""Networks that are tied to a number of cameras; the others ran on both sets."""


def v1_compared() -> dict[str, set[str]]:
    """List the arrays of each file that the tests of POEM v1 and the baselines compare."""
    keys: dict[str, set[str]] = {}
    for case, key, _ in (*test_v1_poem_parity.COMPARED, *test_v1_mesh_parity.COMPARED):
        keys.setdefault(f"golden_{case}", set()).add(key)
    for model, checks in test_v1_mvp_parity.COMPARED.items():
        keys[f"golden_{model}_{test_v1_mvp_parity.CASES[model]}"] = set(checks)
    return keys


FIT_KEYS = {
    "keypoints": 'golden["keypoints"]',
    "cam_intr": 'golden["cam_intr"]',
    "cam_extr_master_to_cam": 'golden["cam_extr_master_to_cam"]',
    "init_pose": 'golden["init_pose"]',
    "iter*/hand_pose": "hand_pose",
    "iter*/hand_shape": "hand_shape",
    "iter*/hand_tsl": "hand_tsl",
    "reprojection_loss": 'golden["reprojection_loss"]',
    "lr": 'golden["lr"]',
    "final_*": 'golden["final_',
    "gt_joints": 'golden["gt_joints"]',
    "anat/*": "anat/",
}
"""The arrays of `golden_fit`, and how the tests of the fit name them."""


def v1_goldens(networks: set[str]) -> set[str]:
    return {f"golden_{name}_{s}" for name in networks for s in V1_INPUT_SETS.get(name, "ab")}


def test_the_files_of_v1_are_known() -> None:
    goldens = {f"{name}.npz" for name in v1_goldens(V1_NETWORKS)}
    manifests = {f"manifest_{name}.json" for name in V1_NETWORKS}
    assert {path.name for path in V1.iterdir()} == V1_USED | goldens | manifests | V1_INPUTS


def test_the_arrays_of_the_networks_of_v1_are_compared() -> None:
    compared = v1_compared()
    assert compared.keys() == v1_goldens(V1_NETWORKS)
    for name, keys in compared.items():
        with np.load(V1 / f"{name}.npz") as arrays:
            assert keys == set(arrays.files), name
    assert set(test_v1_import.VARIANTS) == V1_NETWORKS


def test_the_arrays_of_the_fit_of_v1_are_compared() -> None:
    with np.load(V1 / "golden_fit.npz") as arrays:
        stored = set(arrays.files)
    matched = {pattern: set(fnmatch.filter(stored, pattern)) for pattern in FIT_KEYS}
    assert set().union(*matched.values()) == stored
    assert all(matched.values())
    tests = Path(__file__).resolve().parents[1] / "fitting"
    source = "".join(path.read_text() for path in sorted(tests.glob("*.py")))
    assert [key for key, text in FIT_KEYS.items() if text not in source] == []


def test_the_metrics_and_crops_of_v1_are_compared() -> None:
    """The crops by their own test, whose source names every key that it reads."""
    with np.load(V1 / "golden_transform_metrics.npz") as arrays:
        stored = set(arrays.files)
    source = Path(test_crops_golden.__file__).read_text()
    crops = {key for key in stored if f'g["{key.rpartition("/")[2]}"]' in source and "/" in key}
    metrics = {*test_metrics_golden.V1_METRICS, *test_metrics_golden.V1_POINTS}
    assert stored == crops | test_crops_golden.UNREAD | metrics
    assert crops.isdisjoint(metrics | test_crops_golden.UNREAD)
