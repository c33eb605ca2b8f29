"""Few offsets stand for the 135 of a pose."""

import numpy as np
import pytest

from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.corrections import few_corrections
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.poses import sample_pose


@pytest.mark.parametrize("frames", [1, 30])
def test_they_add_up_to_the_correction(frames):
    hand = default_hand()
    rotations = rotation_from_axis_angle(sample_pose(np.random.default_rng(0), frames))
    base, targets, weights = few_corrections(hand, rotations)
    features = (rotations[:, 1:] - np.eye(3)).reshape(frames, -1)
    expected = np.einsum("vcp,fp->fvc", hand.posedirs.astype(float), features)
    mixed = base + np.einsum("fk,kvc->fvc", weights, targets)
    np.testing.assert_allclose(mixed, expected, atol=3e-5)
    assert ((weights >= 0) & (weights <= 1)).all()
    assert len(targets) < min(frames, 60)
    assert np.abs(expected).max() > 1e-3


def test_a_flat_hand_needs_none():
    base, targets, weights = few_corrections(default_hand(), np.tile(np.eye(3), (4, 16, 1, 1)))
    np.testing.assert_allclose(base, 0, atol=1e-12)
    assert targets.shape == (0, 778, 3)
    assert weights.shape == (4, 0)
