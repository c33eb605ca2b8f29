"""The weights of the two networks, as they ship: float16 arrays named by their place, beside a NOTICE.

`tools/convert_detector.py` made them.
"""

from functools import cache
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np

from poem_jax.detection.landmark_network import LandmarkWeights, landmark_shapes
from poem_jax.detection.palm_network import PalmWeights, palm_shapes
from poem_jax.io.npz_file import read_npz

FOLDER = Path(__file__).parent / "weights"
PALM_FILE, LANDMARK_FILE = FOLDER / "palm.npz", FOLDER / "landmarks.npz"

_Weights = TypeVar("_Weights")


@cache
def palm_weights() -> PalmWeights:
    """Return the weights of the palm network."""
    return _read(PALM_FILE, palm_shapes())


@cache
def landmark_weights() -> LandmarkWeights:
    """Return the weights of the landmark network."""
    return _read(LANDMARK_FILE, landmark_shapes())


def weight_names(weights: PalmWeights | LandmarkWeights) -> list[str]:
    """Return the name of every array of a network in a file, such as `stages/0/mix/kernel`."""
    places, _ = jax.tree_util.tree_flatten_with_path(weights)
    return [jax.tree_util.keystr(place, simple=True, separator="/") for place, _ in places]


def _read(path: Path, shapes: _Weights) -> _Weights:
    names = weight_names(shapes)  # type: ignore[arg-type]
    stored = read_npz(path, required=names)
    leaves, structure = jax.tree.flatten(shapes)
    arrays = [np.asarray(stored[name], np.float32) for name in names]
    for name, array, leaf in zip(names, arrays, leaves, strict=True):
        if array.shape != leaf.shape:
            raise ValueError(f"`{name}` in {path} must have shape {leaf.shape}; got {array.shape}")
    return jax.tree.unflatten(structure, arrays)
