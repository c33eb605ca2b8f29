"""The filter that looks back only: it calms what rests, follows what moves, and never overshoots."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.fitting.causal import CausalFilter, FrameNoise
from poem_jax.fitting.moving_hands import MeshHand

NO_POINTS = np.zeros((0, 3))
HAND = 0.05 * np.random.default_rng(0).normal(size=(21, 3))
RATE = 30


def follow(time_s, joints, most_noise_m=None) -> np.ndarray:
    """Run the filter over joints (frame, 21, 3)."""
    one = CausalFilter()
    hands = (MeshHand(each, NO_POINTS) for each in joints)
    return np.stack([one.update(t, hand, most_noise_m).joints for t, hand in zip(time_s, hands, strict=True)])


def along(places) -> np.ndarray:
    """A rigid hand at places (frame, 3)."""
    return HAND + np.asarray(places)[:, None]


def tremble(shape, sigma_m, seed=0) -> np.ndarray:
    """Noise of every joint by itself, and of the hand as a whole."""
    rng = np.random.default_rng(seed)
    return sigma_m * (0.6 * rng.normal(size=shape) + 0.8 * rng.normal(size=(shape[0], 1, 3)))


def rms(x) -> float:
    return float(np.sqrt(np.mean(np.sum(np.square(x), -1))))


def test_a_hand_at_rest_stays():
    joints = along(np.zeros((20, 3)))
    np.testing.assert_allclose(follow(np.arange(20) / RATE, joints), joints, atol=1e-12)


@pytest.mark.parametrize("sigma_m", [0.0005, 0.004])
def test_a_hand_at_rest_trembles_less(sigma_m):
    """Whatever the noise; it need not be known."""
    truth = along(np.zeros((90, 3)))
    seen = truth + tremble(truth.shape, sigma_m)
    followed = follow(np.arange(90) / RATE, seen)
    assert rms(followed[30:] - truth[30:]) < rms(seen - truth) / 2.5
    assert rms(np.diff(followed[30:], 2, 0)) < rms(np.diff(seen, 2, 0)) / 2.5


@pytest.mark.parametrize(("speed", "sigma_m"), [(0.2, 0.0015), (0.5, 0.0), (2.0, 0.0015)])
def test_a_moving_hand_is_no_more_than_50_ms_late(speed, sigma_m):
    time_s = np.arange(60) / RATE
    truth = along(speed * time_s[:, None] * [1, 0, 0])
    followed = follow(time_s, truth + tremble(truth.shape, sigma_m), 0.0015)
    late = np.mean((truth - followed)[30:, :, 0]) / speed
    assert -0.002 < late < 0.05


def test_a_jump_is_followed_at_once_and_never_overshot():
    places = np.zeros((60, 3))
    places[30:, 0] = 0.2
    followed = follow(np.arange(60) / RATE, along(places))[:, 0, 0] - HAND[0, 0]
    assert (np.diff(followed) > -1e-12).all()
    assert followed.max() < 0.2 + 1e-12
    assert followed[30] > 0.19


def test_uneven_moments_give_what_even_ones_give():
    """One curve, seen at 60 moments a second, or at a third of them at random: the filter is the same."""
    rng = np.random.default_rng(0)
    even = np.arange(90) / 60
    some = np.sort(rng.choice(np.arange(1, 89), 30, replace=False))
    curve = along(np.stack([0.1 * np.sin(2 * even), 0.05 * np.cos(3 * even), 0 * even], -1))
    every, few = follow(even, curve, 0.002), follow(even[some], curve[some], 0.002)
    assert np.linalg.norm(every[some] - few, axis=-1)[5:].mean() < 0.002
    assert np.linalg.norm(curve - curve.mean(0), axis=-1).mean() > 0.03, "it is not at rest"


def test_the_rate_of_a_hand_at_rest_is_in_seconds():
    """A hand that trembles is averaged as long at 120 moments a second as at 30: twice as well."""
    left = []
    for rate in (30, 120):
        truth = along(np.zeros((rate, 3)))
        seen = truth + 0.002 * np.random.default_rng(0).normal(size=truth.shape)
        left.append(rms((follow(np.arange(rate) / rate, seen) - truth)[rate // 2 :]))
    assert left[0] / left[1] == pytest.approx(2, rel=0.25)


def test_moving_the_world_moves_what_is_filtered():
    time_s = np.arange(40) / RATE
    joints = along(0.3 * time_s[:, None] * [1, 2, 0])
    seen = joints + tremble(joints.shape, 0.002)
    R, t = Rotation.random(rng=1), np.array([3.0, 1.0, -2.0])

    def moved(x):
        return R.apply(x.reshape(-1, 3)).reshape(x.shape) + t

    np.testing.assert_allclose(follow(time_s, moved(seen)), moved(follow(time_s, seen)), atol=1e-9)


def test_a_hand_that_spins_is_followed_across_half_a_circle():
    time_s = np.arange(60) / RATE
    turns = Rotation.from_rotvec(4 * time_s[:, None] * [0, 0, 1])
    joints = np.stack([turn.apply(HAND) for turn in turns])
    followed = follow(time_s, joints, 0.0015)
    assert np.linalg.norm(followed - joints, axis=-1).max() < 0.008
    size = [np.linalg.norm(x - x.mean(1, keepdims=True), axis=-1).mean() for x in (followed, joints)]
    np.testing.assert_allclose(*size, rtol=0.001)


def test_after_a_gap_it_begins_anew():
    time_s = np.array([0, 1, 2, 3, 30, 31]) / RATE
    joints = along(0.001 * np.arange(6)[:, None] * [1, 0, 0])
    followed = follow(time_s, joints)
    np.testing.assert_array_equal(followed[4], joints[4])
    assert not np.allclose(followed[3], joints[3])


def test_moments_must_grow():
    one = CausalFilter()
    one.update(1.0, MeshHand(HAND, NO_POINTS))
    with pytest.raises(ValueError, match="later and later"):
        one.update(1.0, MeshHand(HAND, NO_POINTS))


@pytest.mark.parametrize("pace", [0.0, 0.3])
def test_the_noise_is_measured_on_the_way(pace):
    """Also of a hand that moves steadily, at uneven moments."""
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.02, 0.06, 60))
    noise = FrameNoise()
    joints = along(pace * time_s[:, None] * [0, 1, 0]) + 0.002 * rng.normal(size=(60, 21, 3))
    found = [noise.update(t, each) for t, each in zip(time_s, joints, strict=True)]
    assert np.isinf(found[5])
    assert found[-1] == pytest.approx(0.002, rel=0.1)
