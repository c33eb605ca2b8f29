"""The pose corrections of a moving hand as a few offsets that are mixed.

MANO's correction of a pose is linear in 135 numbers, most of which change together or not at all in a take.
Programs that skin a mesh take such offsets as morph targets (shape keys); the fewer, the better.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import NUM_POSE_FEATURES, NUM_VERTICES
from poem_jax.typing import Array, Float

_TOLERANCE_M = 3e-5
"""What is left out of the correction, root sum of squares over the hand's vertices, in the worst frame."""
_NO_DIRECTION = 1e-12
"""Share of the largest squared strength below which a direction is taken for rounding."""


class Corrections(NamedTuple):
    """correction of frame f = sum_k weights[f, k] targets[k]; the weights are within -1 and 1."""

    targets: Float[np.ndarray, "target 778 3"]
    """Offsets of the rest vertices, metres."""
    weights: Float[np.ndarray, "frame target"]


def few_corrections(hand: HandModel, rotations: Float[Array, "frame 16 3 3"]) -> Corrections:
    """Return the pose corrections of some poses as few offsets (principal components), NumPy only.

    No vertex is off by more than 0.03 mm.

    Args:
        hand: Of either side.
        rotations: Relative to the parent joints, MANO order; one frame at least, finite.
    """
    features = np.asarray(rotations, np.float64)[:, 1:] - np.eye(3)
    directions = np.asarray(hand.posedirs, np.float64).reshape(-1, NUM_POSE_FEATURES)
    # Along an orthonormal basis of all offsets, directions @ turn / strength, so that lengths are theirs.
    squares, turn = np.linalg.eigh(directions.T @ directions)
    strength = np.sqrt(np.maximum(squares, _NO_DIRECTION * squares[-1]))
    along = features.reshape(len(features), -1) @ (turn * strength)
    _, principal = np.linalg.eigh(along.T @ along)
    principal = principal[:, ::-1]
    mixed = along @ principal
    left_out = np.sqrt(np.cumsum(mixed[:, ::-1] ** 2, axis=1)[:, ::-1]).max(0)
    count = int((left_out > _TOLERANCE_M).sum())
    largest = np.abs(mixed[:, :count]).max(0)
    targets = (directions @ (turn / strength) @ (principal[:, :count] * largest)).T
    return Corrections(targets.reshape(count, NUM_VERTICES, 3), mixed[:, :count] / largest)
