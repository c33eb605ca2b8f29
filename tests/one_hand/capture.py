"""A capture of one frame: four views of sample 0, seed 0 of the synthetic benchmark, and its ground truth.

Made by `python -m tests.one_hand.make`.
"""

from pathlib import Path

import numpy as np

from poem_jax.typing import Array, Float

GROUND_TRUTH = "ground_truth.npz"


def one_hand_folder() -> Path:
    """Return the folder with four images, `rig.json`, `boxes.npz` and `ground_truth.npz`."""
    return Path(__file__).parent


def one_hand_truth() -> tuple[Float[Array, "1 778 3"], Float[Array, "1 21 3"]]:
    """Return true vertices and joints, metres, in the world of `rig.json`."""
    with np.load(one_hand_folder() / GROUND_TRUTH) as stored:
        return stored["vertices_world"], stored["joints_world"]
