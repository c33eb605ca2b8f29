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
    """correction of frame f = base + sum_k weights[f, k] targets[k]."""

    base: Float[np.ndarray, "778 3"]
    """Offsets of the rest vertices in all frames, metres."""
    targets: Float[np.ndarray, "target 778 3"]
    """Offsets of the rest vertices, metres."""
    weights: Float[np.ndarray, "frame target"]
    """Within 0 and 1, to which some programs hold them."""


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
    mean = along.mean(0)
    _, principal = np.linalg.eigh((along - mean).T @ (along - mean))
    principal = principal[:, ::-1]
    mixed = (along - mean) @ principal
    left_out = np.sqrt(np.cumsum(mixed[:, ::-1] ** 2, axis=1)[:, ::-1]).max(0)
    count = int((left_out > _TOLERANCE_M).sum())
    principal, mixed = principal[:, :count], mixed[:, :count]
    lowest, extent = mixed.min(0), np.ptp(mixed, axis=0)
    basis = directions @ (turn / strength)
    base = (basis @ (mean + principal @ lowest)).reshape(NUM_VERTICES, 3)
    targets = (basis @ (principal * extent)).T.reshape(count, NUM_VERTICES, 3)
    return Corrections(base, targets, (mixed - lowest) / extent)
