"""Times that serve animations, and the shape that all frames share."""

import numpy as np
import pytest

from poem_jax.capture.outputs.motion import frame_times, seconds_per_frame


def test_times_that_are_not_known_are_those_of_a_video():
    np.testing.assert_allclose(frame_times(np.full(4, np.nan)), np.arange(4) / 30)
    assert seconds_per_frame(np.array([3.0])) == pytest.approx(1 / 30)


def test_times_that_are_known_stay():
    times = np.array([0.5, 0.7, 1.4])
    np.testing.assert_array_equal(frame_times(times), times)


@pytest.mark.parametrize("times", [[0.0, 0.1, 0.1], [0.0, np.nan, 0.2]])
def test_times_that_cannot_be_are_told(times, caplog):
    np.testing.assert_allclose(frame_times(np.array(times)), np.arange(3) / 30)
    assert "do not increase, or some are missing" in caplog.text


def test_one_shape_for_all_frames(planted, tmp_path):
    take = planted()
    odd = take.frames[3].hands[0]._replace(shape=np.full(10, 9.0))
    frames = [f._replace(hands=(odd, f.hands[1])) if i == 3 else f for i, f in enumerate(take.frames)]
    motion = take._replace(frames=frames).motion(tmp_path / "a.npz")
    np.testing.assert_allclose(motion.hands[0].skeleton.shape, take.shape[0], atol=1e-6)
    assert motion.hands[1].seen.tolist() == take.seen[:, 1].tolist()
    assert motion.hands[0].bridged.tolist() == [False] * 4 + [True] + [False] * 4


def test_results_without_a_pose_get_that_of_their_joints(planted, tmp_path):
    motion = planted(pose=False).motion(tmp_path / "a.npz")
    for hand in motion.hands:
        assert hand.skeleton.from_joints
        (frame, *_) = np.flatnonzero(hand.seen)
        posed = hand.skeleton.shaped.pose_rotations(hand.skeleton.rotations[frame])
        found = posed.skeleton - posed.skeleton[0] + hand.joints[frame, 0]
        at = [0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3]
        assert np.linalg.norm(found - hand.joints[frame, at], axis=-1).max() < 0.003
