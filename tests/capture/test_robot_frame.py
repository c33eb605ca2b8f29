"""The palm's axes, whatever the world's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.capture.robot_frame import joints_in_palm_frame
from poem_jax.hand.joint_limits import anatomical_axes
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand

MIDDLE_TIP, MIDDLE_KNUCKLE, THUMB_TIP, LITTLE_TIP = 12, 9, 4, 20


@pytest.mark.parametrize(("side", "thumbs"), [("right", 1), ("left", -1)])
def test_a_hand_stands_on_its_wrist_and_its_palm_faces_forwards(side, thumbs):
    hand = default_hand(side)
    pose = np.zeros((16, 3))
    flat = joints_in_palm_frame(hand_mesh(hand, pose, np.zeros(10)).joints, side=side)
    np.testing.assert_allclose(flat[0], 0, atol=1e-12)
    np.testing.assert_allclose(flat[MIDDLE_KNUCKLE, :2], 0, atol=1e-9)
    assert flat[MIDDLE_TIP, 2] > flat[MIDDLE_KNUCKLE, 2] > 0
    assert thumbs * flat[THUMB_TIP, 1] > 0.03
    assert thumbs * flat[LITTLE_TIP, 1] < -0.02
    pose[1:] = np.deg2rad(60) * anatomical_axes(hand)[:, 0]
    fist = joints_in_palm_frame(hand_mesh(hand, pose, np.zeros(10)).joints, side=side)
    assert fist[MIDDLE_TIP, 0] > 0.02


def test_the_worlds_axes_do_not_matter():
    rng = np.random.default_rng(0)
    joints = hand_mesh(default_hand(), rng.normal(0, 0.2, (5, 16, 3)), np.zeros((5, 10))).joints
    moved = joints @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3)
    before, after = (joints_in_palm_frame(points, side="right") for points in (joints, moved))
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_a_side_is_a_side():
    with pytest.raises(ValueError, match='`side` must be "right" or "left"; got \'both\''):
        joints_in_palm_frame(np.zeros((21, 3)), side="both")
