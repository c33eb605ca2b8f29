"""A stand-in for the user's `MANO_RIGHT.pkl`: our own hand under MANO's field names.

MANO may not be copied, so miniatures are made with the hand that ships. The mean pose and the principal
components are ours too. The mean is far from zero, so that a reader that forgets it, or adds it twice, is
wrong by centimetres.
"""

import pickle
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse import csc_matrix

from poem_jax.hand.conventions import FINGER_NUMBERS, PoseComponents
from poem_jax.hand.model import HandModel, mirror_pose
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import MANO_PARENTS, NUM_SKELETON_JOINTS

_MEAN_FLEXION = (0.35, 0.5, 0.3)
"""Turn about z, which bends a finger, of each finger's three joints, radians."""
_NO_PARENT = 2**32 - 1


def write_mano(path: str | Path, side: str = "right") -> Path:
    """Write our hand as a pickle with the fields of a MANO file; return the path.

    Args:
        path: file to write; call it MANO_RIGHT.pkl or MANO_LEFT.pkl, as the real ones.
        side: "right" or "left".
    """
    path = Path(path)
    hand, components = stand_in_hand(side), stand_in_components(side)
    fields = {
        "v_template": hand.v_template.astype(np.float64),
        "shapedirs": hand.shapedirs.astype(np.float64),
        "posedirs": hand.posedirs.astype(np.float64),
        "J_regressor": csc_matrix(hand.J_regressor.astype(np.float64)),
        "J": hand.J_regressor.astype(np.float64) @ hand.v_template,
        "weights": hand.weights.astype(np.float64),
        "f": hand.faces.astype(np.uint32),
        "kintree_table": np.array(
            [[_NO_PARENT, *MANO_PARENTS[1:]], range(NUM_SKELETON_JOINTS)], dtype=np.int64
        ),
        "hands_mean": components.mean.astype(np.float64),
        "hands_components": components.components.astype(np.float64),
        "hands_coeffs": np.zeros((1, FINGER_NUMBERS)),
        "bs_type": "lrotmin",
        "bs_style": "lbs",
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(fields, protocol=2))
    return path


def stand_in_hand(side: str = "right") -> HandModel:
    """Return the hand that `write_mano` writes."""
    return default_hand(side)


@cache
def stand_in_components(side: str = "right") -> PoseComponents:
    """Return the mean pose and the orthonormal components that `write_mano` writes, float32."""
    rng = np.random.default_rng(45)
    mean = np.zeros((NUM_SKELETON_JOINTS - 1, 3))
    mean[:, 2] = np.tile(_MEAN_FLEXION, len(mean) // 3)
    mean += rng.uniform(-0.1, 0.1, mean.shape)
    components = np.linalg.qr(rng.standard_normal((FINGER_NUMBERS, FINGER_NUMBERS)))[0]
    if side == "left":
        mean = mirror_pose(mean)
        components = mirror_pose(components.reshape(FINGER_NUMBERS, -1, 3)).reshape(components.shape)
    arrays = PoseComponents(mean.reshape(-1).astype(np.float32), components.astype(np.float32))
    for array in arrays:
        array.setflags(write=False)
    return arrays
