"""Hands that keep their identity moment by moment, with what a detector does wrong planted."""

import numpy as np
import pytest

from poem_jax.capture.live.following import SIDES, HandFollower
from tests.capture import planted_scenes as planted
from tests.capture.live.fake_cameras import PERIOD_S, RIG, seen_hands, true_joints


def follow(frames, rig=RIG, period_s=PERIOD_S):
    follower = HandFollower(rig)
    return [follower.follow(number * period_s, found) for number, found in enumerate(frames)]


def views_of(time_s, sides=SIDES, order=(0, 1)):
    return [[seen_hands(view, true_joints(time_s), sides)[i] for i in order] for view in range(RIG.num_views)]


def is_hand(followed, time_s):
    """Whether each slot holds the true hand in every view."""
    truth = [[hand.keypoints_px for hand in seen] for seen in views_of(time_s)]
    return [
        all(np.array_equal(followed.keypoints_px[h, v], truth[v][h]) for v in range(RIG.num_views))
        for h in range(2)
    ]


def test_hands_are_known_from_the_first_moment_in_whatever_order_they_are_found():
    rng = np.random.default_rng(0)
    frames = [views_of(i * PERIOD_S, order=rng.permutation(2)) for i in range(8)]
    for number, followed in enumerate(follow(frames)):
        assert is_hand(followed, number * PERIOD_S) == [True, True]
        np.testing.assert_array_equal(followed.score, 0.9)
        assert followed.placed == 2


def test_wrong_sides_for_a_while_exchange_nothing():
    frames = [views_of(i * PERIOD_S, SIDES if i < 5 or i > 7 else SIDES[::-1]) for i in range(10)]
    for number, followed in enumerate(follow(frames)):
        assert is_hand(followed, number * PERIOD_S) == [True, True]


def test_what_comes_later_changes_nothing():
    frames = [views_of(i * PERIOD_S) for i in range(8)]
    for one, other in zip(follow(frames), follow(frames[:4]), strict=False):
        np.testing.assert_array_equal(one.keypoints_px, other.keypoints_px)


def test_a_hand_that_leaves_comes_back_as_itself():
    gone = [[[hand for hand in seen if hand.side == "left"] for seen in views_of(i * 0.1)] for i in range(18)]
    frames = [gone[i] if 3 <= i < 15 else views_of(i * 0.1) for i in range(18)]
    for number, followed in enumerate(follow(frames, period_s=0.1)):
        seen = is_hand(followed, number * 0.1)
        assert seen == [not 3 <= number < 15, True]
        if not seen[0]:
            assert np.isnan(followed.keypoints_px[0]).all()
            assert np.isnan(followed.score[0]).all()


def test_moving_the_world_changes_nothing():
    """A rig far from its origin, as of a map, too."""
    frames = [views_of(i * PERIOD_S) for i in range(6)]
    away = np.eye(4)
    away[:3, 3] = [5e5, -2e5, 300.0]
    moved = RIG._replace(T_cam_from_world=RIG.T_cam_from_world @ np.linalg.inv(away))
    for one, other in zip(follow(frames), follow(frames, moved), strict=True):
        np.testing.assert_array_equal(one.keypoints_px, other.keypoints_px)


@pytest.mark.parametrize("kind", [planted.clean, planted.seen_twice, planted.missed_views])
def test_planted_scenes(kind):
    """What is given for a hand is of that hand: 97 of 100 detections and more."""
    right = wrong = there = 0
    for seed in range(2):
        scene = planted.planted(kind, "four", seed)
        for frame, followed in enumerate(follow(scene.found, scene.rig, 1 / 12)):
            for view, (found, truth) in enumerate(zip(scene.found[frame], scene.truth[frame], strict=True)):
                there += sum(t != planted.FALSE for t in truth)
                for hand in range(2):
                    if np.isnan(followed.score[hand, view]):
                        continue
                    same = [
                        t
                        for d, t in zip(found, truth, strict=True)
                        if np.array_equal(d.keypoints_px, followed.keypoints_px[hand, view])
                    ]
                    is_right = [t for t in same if t >= 0 and scene.sides[t] == SIDES[hand]]
                    right, wrong = right + bool(is_right), wrong + (not is_right)
    assert right >= 0.97 * (right + wrong), (right, wrong)
    assert right >= 0.8 * there, (right, there)
