"""The two hands' motion: possible for a person, closed in time, and never through each other."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from poem_jax.data.lens import project_raw
from poem_jax.hand.joint_limits import POSE_LIMITS
from poem_jax.hand.topology import WRIST
from poem_jax.synthetic.desk.cameras import FRAMES_PER_SECOND, desk_rig, frame_times
from poem_jax.synthetic.desk.motion import PERIOD_S, SIDES, finger_angles, hands_at
from poem_jax.synthetic.finger_collisions import posed_fingers, smallest_gap
from poem_jax.synthetic.poses import angles_to_pose

TIMES = np.arange(0, PERIOD_S, 0.05)


@pytest.fixture(scope="module")
def moments():
    return [hands_at(time) for time in TIMES]


@pytest.mark.parametrize("side", SIDES)
def test_joints_stay_within_their_limits_and_fingers_apart(side):
    angles = np.stack([finger_angles(side, time) for time in TIMES])
    assert np.all(angles >= POSE_LIMITS[..., 0] - 1e-9)
    assert np.all(angles <= POSE_LIMITS[..., 1] + 1e-9)
    # Capsules are wider than fingers; a finger on the palm or another finger overlaps a little.
    assert smallest_gap(posed_fingers(angles_to_pose(angles))).min() > -0.006


def test_it_ends_where_it_began():
    for before, after in zip(hands_at(0.1), hands_at(0.1 + PERIOD_S), strict=True):
        np.testing.assert_allclose(before, after, atol=1e-6)
    assert len(frame_times()) == pytest.approx(PERIOD_S * FRAMES_PER_SECOND)


def test_hands_move_but_not_faster_than_hands_do(moments):
    joints = np.stack([hands.joints_world for hands in moments])
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1) / 0.05
    assert speed.max() < 2.0
    assert np.median(speed) > 0.05


def test_hands_pass_close_to_each_other_without_touching(moments):
    gaps = [KDTree(left).query(right)[0].min() for left, right in (hands.vertices_world for hands in moments)]
    assert 0.008 < min(gaps) < 0.06


def test_a_hand_turns_about_its_wrist_in_the_way_that_the_pose_says():
    """Sides are not exchanged: the thumb of the hand at the left points to the right when its palm faces
    away from the person."""
    left, right = SIDES.index("left"), SIDES.index("right")
    joints = hands_at(0.0).joints_world
    assert joints[left, WRIST, 0] < 0 < joints[right, WRIST, 0]
    assert joints[left, 4, 0] > joints[left, 20, 0]
    assert joints[right, 4, 0] < joints[right, 20, 0]


def test_every_camera_sees_both_hands_whole(moments):
    rig = desk_rig()
    vertices = np.stack([hands.vertices_world for hands in moments])
    for view in range(rig.num_views):
        pixels, _ = project_raw(rig, view, vertices.reshape(-1, 3))
        pixels = pixels.reshape(*vertices.shape[:3], 2)
        assert np.all(pixels > 4)
        assert np.all(pixels < rig.size_wh[view] - 4)
        assert np.ptp(pixels, axis=2).max(-1).min() > 100
    assert vertices[..., 2].min() > 0.05
