"""The capture that ships: four views of sample 0, seed 0 of the synthetic benchmark, and its ground truth.

Made by `tools/make_demo.py`.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from poem_jax.evaluation.metrics import evaluate
from poem_jax.typing import Array, Float

GROUND_TRUTH = "ground_truth.npz"


def demo_folder() -> Path:
    """Return the folder with four images, `rig.json`, `boxes.npz` and `ground_truth.npz`."""
    return Path(__file__).parent


def ground_truth() -> tuple[Float[Array, "1 778 3"], Float[Array, "1 21 3"]]:
    """Return true vertices and joints, metres, in the world of `rig.json`."""
    with np.load(demo_folder() / GROUND_TRUTH) as stored:
        return stored["vertices_world"], stored["joints_world"]


def mpvpe_mm(arrays: Mapping[str, Array]) -> float:
    """Return the mean distance of vertices to the truth in millimetres; `arrays` as in `prediction.npz`."""
    vertices, joints = ground_truth()
    scores = evaluate(
        arrays["joints_world"][:, 0], joints, arrays["vertices_world"][:, 0], vertices, protocol="poem"
    )
    return scores["mpvpe_mm"]
