"""Shape and pose from joints alone."""

import numpy as np
import pytest

from poem_jax.hand.bones import bone_lengths, rest_keypoints, rotations_of_joints, shape_of_bones
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.poses import sample_pose


@pytest.mark.parametrize("side", ["right", "left"])
def test_lengths_of_bones_come_back(side):
    hand = default_hand(side)
    shape = np.random.default_rng(0).normal(size=10)
    lengths = bone_lengths(rest_keypoints(hand, shape))
    found = shape_of_bones(hand, lengths)
    np.testing.assert_allclose(bone_lengths(rest_keypoints(hand, found)), lengths, atol=5e-4)


def test_a_hand_of_other_lengths_is_not_stretched_beyond_people():
    hand = default_hand()
    lengths = 3 * bone_lengths(rest_keypoints(hand, np.zeros(10)))
    found = shape_of_bones(hand, lengths)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("side", ["right", "left"])
def test_joints_come_back_from_the_turns_that_they_give(side):
    """Turns about a bone do not show; the joints do."""
    hand = default_hand(side)
    rng = np.random.default_rng(1)
    pose, shape = sample_pose(rng, 8), rng.normal(size=10)
    pose[:, 0] = rng.normal(size=(8, 3))
    if side == "left":
        pose = pose * [1, -1, -1]
    joints = hand_mesh(hand, pose, np.broadcast_to(shape, (8, 10)), rng.normal(size=(8, 3))).joints
    rotations = rotations_of_joints(hand, shape, joints)
    posed = hand.shape(shape).pose_rotations(rotations)
    again = posed.skin().joints
    again = again - again[:, :1] + joints[:, :1]
    skeleton = [j for j in range(21) if j not in (4, 8, 12, 16, 20)]
    np.testing.assert_allclose(again[:, skeleton], joints[:, skeleton], atol=1e-4)
    # Tips are vertices, which follow the corrections of the pose, too.
    assert np.linalg.norm(again - joints, axis=-1).max() < 0.004
