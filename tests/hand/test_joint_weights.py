"""Numbers of joints on a mesh: every vertex takes those of the joints beside it, and of its own finger."""

import numpy as np

from poem_jax.hand.joint_weights import vertex_joint_weights
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import FINGER_JOINTS, TIP_VERTICES_LAYER


def weights_of(side):
    hand = default_hand(side)
    return hand, vertex_joint_weights(hand.v_template, hand.J_regressor, hand.weights)


def test_a_constant_stays_what_it_is_and_every_joint_counts_somewhere():
    _, weights = weights_of("right")
    assert weights.shape == (778, 21)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights @ np.full(21, 3.0), 3.0)
    assert (weights.max(0) > 0.6).all()


def test_tips_are_the_tips_and_fingers_do_not_mix():
    hand, weights = weights_of("right")
    assert weights[list(TIP_VERTICES_LAYER)].argmax(-1).tolist() == [finger[3] for finger in FINGER_JOINTS]
    outer = np.array([finger[2:] for finger in FINGER_JOINTS])
    shares = weights[:, outer].sum(-1)
    on_a_finger = shares.max(-1) > 0.5
    assert on_a_finger.sum() > 200
    assert np.sort(shares[on_a_finger], axis=-1)[:, -2].max() < 0.02
    assert hand.faces.max() < len(weights)


def test_both_sides_agree():
    np.testing.assert_allclose(weights_of("left")[1], weights_of("right")[1], atol=1e-3)
