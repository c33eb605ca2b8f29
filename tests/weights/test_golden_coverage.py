"""Every array and number that the release stored is compared somewhere.

The tables in question are those that the tests themselves run over. The metrics have no table: their tests
run here once more, and tell which keys they read.
"""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from poem_jax.evaluation.metrics import evaluate, mean_error, point_distances
from tests.evaluation import test_metrics_golden
from tests.weights import test_release_parity, test_release_stages, test_release_training
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
def test_every_stored_key_is_compared_and_every_compared_key_is_stored(name: str) -> None:
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
