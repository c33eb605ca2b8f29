"""Motions of a hand: a function of time, at the pace that was asked for."""

import numpy as np
import pytest

from poem_jax.geometry.cameras import project
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.moving_takes import Motion, see_motion


def test_a_motion_is_a_function_of_time():
    time_s = np.arange(60) / 30
    pose, place = Motion(3).at(time_s)
    again, there = Motion(3).at(time_s[::3])
    np.testing.assert_array_equal(pose[::3], again)
    np.testing.assert_array_equal(place[::3], there)
    faster, further = Motion(3, pace=2.0, seconds=5.0).at(time_s / 2)
    assert np.abs(Motion(4).at(time_s)[1] - place).max() > 0.01
    np.testing.assert_allclose(faster, pose, atol=1e-6)
    np.testing.assert_allclose(further, place, atol=1e-6)


def test_pace_is_speed():
    time_s = np.arange(0, 8, 0.04)
    for pace in (0.0, 0.5, 2.0):
        speed = [
            np.linalg.norm(np.diff(Motion(seed, pace).at(time_s)[1], axis=0), axis=-1).mean() / 0.04
            for seed in range(2)
        ]
        assert np.mean(speed) == pytest.approx(0.5 * pace, rel=0.35)


@pytest.mark.parametrize("side", ["right", "left"])
def test_what_is_seen_is_the_motion(side):
    take = see_motion(Motion(0), default_hand(side), np.arange(5) / 30, 3, 0.0, 1)
    uv, _ = project(take.K[None], take.T_cam_from_world[None], take.joints[:, None])
    np.testing.assert_allclose(uv, take.uv_px, atol=1e-3)
    np.testing.assert_allclose(take.joints[:, 9], Motion(0).at(np.arange(5) / 30)[1], atol=1e-6)
