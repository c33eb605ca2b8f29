"""The stage `smooth`: streams of frames with results in, the same with calmer and bridged hands out."""

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.frame_times import SECONDS_PER_FRAME, timed, times_of
from poem_jax.capture.jitter import Jitter
from poem_jax.capture.judge import judge_hands
from poem_jax.capture.smoothing import Smoother, Smoothing
from poem_jax.capture.take import Take
from poem_jax.cli.fit import smoothing_of
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.pair import hands_of
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.synthetic.moving_takes import Motion
from tests.rigs import small_rig

RIG = small_rig()
MODELS = hands_of(default_hand())
SEEN, UNSEEN = np.ones(3, bool), np.zeros(3, bool)
MODES = ("offline", "causal")


def results(motion: Motion, time_s, posed: bool, noise_m: float = 0.0, seed: int = 0) -> list[HandResult]:
    """What an engine makes of a motion: a hand model's pose, or points; its place trembles."""
    pose, place = motion.at(time_s)
    place = place + noise_m * np.random.default_rng(seed).normal(size=place.shape)
    shape = np.tile(motion.shape, (len(pose), 1))
    mesh = hand_mesh(default_hand(), pose, shape, place.astype(np.float32))
    found = []
    for f in range(len(pose)):
        joints = mesh.joints[f]
        one = HandResult(
            SEEN, vertices_world=mesh.vertices[f], joints_world=joints, root_world=joints[ROOT_JOINT]
        )
        if posed:
            expected = joints + np.float32(0.003)
            one = one._replace(pose=pose[f], shape=shape[f], translation=place[f], expected_world=expected)
        found.append(one)
    return found


def frames_of(hands: list[HandResult], time_s=None) -> list[Frame]:
    boxes = np.full((1, 3, 4), np.nan)
    times = [None] * len(hands) if time_s is None else time_s
    pairs = zip(hands, times, strict=True)
    return [Frame(f"{i:04d}", boxes, hands=(hand,), time_s=t) for i, (hand, t) in enumerate(pairs)]


def smoothed(frames: list[Frame], mode="offline", bridge_s=0.2, told=None) -> list[HandResult]:
    take = Take(RIG, ("right",) * len(frames[0].hands), frames)
    smoother = Smoother(take, Smoothing(mode, bridge_s), MODELS)
    out = list(smoother.smooth(iter(frames)))
    assert [frame.name for frame in out] == [frame.name for frame in frames]
    if told is not None:
        told.update(smoother.done)
    return [frame.hands[0] for frame in out]


def joints_of(hands: list[HandResult]) -> np.ndarray:
    return np.stack([hand.joints_world for hand in hands])


def unseen(hands: list[HandResult], places) -> list[HandResult]:
    return [
        HandResult(UNSEEN, "seen by nobody") if index in places else hand for index, hand in enumerate(hands)
    ]


def rms_mm(x) -> float:
    return 1000 * float(np.sqrt(np.mean(np.sum(np.square(x), -1))))


@pytest.mark.parametrize(("mode", "posed"), [("offline", False), ("causal", True)])
def test_a_still_hand_stays_and_a_trembling_one_calms_down(mode, posed):
    time_s = np.arange(36) / 30
    rest = partial(results, Motion(0, pace=0.0), time_s, posed)
    truth = joints_of(rest())
    np.testing.assert_allclose(joints_of(smoothed(frames_of(rest()[:8]), mode)), truth[:8], atol=1e-6)
    told = {}
    after = joints_of(smoothed(frames_of(rest(0.003)), mode, told=told))
    assert rms_mm((after - truth)[12:-6]) < rms_mm(joints_of(rest(0.003)) - truth) / 2
    assert told["mode"] == mode
    assert told["bridged_hands"] == 0
    assert told["jitter_after_mm"] < told["jitter_before_mm"] / 2.5


def test_off_changes_nothing():
    frames = frames_of(results(Motion(0), np.arange(5) / 30, True))
    assert list(Smoother(Take(RIG, ("right",), frames), Smoothing(), MODELS).smooth(frames)) == frames


@pytest.mark.parametrize("mode", MODES)
def test_pose_shape_and_place_stay_those_of_the_mesh(mode):
    hands = results(Motion(1), np.arange(15) / 30, True, 0.002)
    for hand in smoothed(frames_of(unseen(hands, (6, 7))), mode):
        mesh = hand_mesh(default_hand(), hand.pose, hand.shape, hand.translation)
        np.testing.assert_allclose(mesh.vertices, hand.vertices_world, atol=1e-5)
        np.testing.assert_allclose(mesh.joints, hand.joints_world, atol=1e-5)
        np.testing.assert_array_equal(hand.root_world, hand.joints_world[ROOT_JOINT])
        offset = np.linalg.norm(hand.expected_world - hand.joints_world, axis=-1)
        np.testing.assert_allclose(offset, 0.0052, rtol=0.2)
        assert hand.vertices_world.dtype == np.float32


@pytest.mark.parametrize("posed", [False, True])
@pytest.mark.parametrize("mode", MODES)
def test_a_short_gap_is_bridged_and_marked(mode, posed):
    """Offline along the way of the hand, in a live picture where it was; nothing is said to be seen."""
    hands = results(Motion(2, pace=0.5), np.arange(18) / 30, posed)
    truth = joints_of(hands)
    gap = range(8, 14)
    told = {}
    frames = frames_of(unseen(hands, gap))
    after = smoothed(frames, mode, told=told)
    assert [hand.bridged for hand in after] == [index in gap for index in range(18)]
    assert told["bridged_hands"] == 6
    for index in gap:
        hand = after[index]
        assert hand.reason is None
        assert not hand.view_mask.any()
        assert hand.joint_sigma_m is None
        assert hand.joint_confidence is None
        last = after[7].joints_world
        error = np.linalg.norm(hand.joints_world - truth[index], axis=-1).max()
        stay = np.linalg.norm(last - truth[index], axis=-1).max()
        assert error < 0.5 * stay if mode == "offline" else np.array_equal(hand.joints_world, last)


@pytest.mark.parametrize("mode", MODES)
def test_a_longer_gap_stays_empty(mode):
    """Offline as a whole; in a live picture the hand cannot know, and goes after the stated time."""
    hands = unseen(results(Motion(2), np.arange(16) / 30, False), range(5, 12))
    after = smoothed(frames_of(hands), mode)
    held = range(5, 11) if mode == "causal" else ()
    assert [hand.bridged for hand in after] == [index in held for index in range(16)]
    assert after[11].reason == "seen by nobody"
    assert [h.reason for h in smoothed(frames_of(hands), mode, bridge_s=0.0)].count("seen by nobody") == 7
    longer = smoothed(frames_of(hands), mode, bridge_s=0.24)
    assert all(hand.reason is None for hand in longer)


@pytest.mark.parametrize("mode", MODES)
def test_before_the_first_and_after_the_last_sight_nothing_is_made_up(mode):
    hands = unseen(results(Motion(2), np.arange(12) / 30, False), (0, 1, 10, 11))
    after = smoothed(frames_of(hands), mode)
    assert [hand.reason is None for hand in after[:10]] == [False] * 2 + [True] * 8
    assert after[11].bridged == (mode == "causal")


def test_two_hands_are_bridged_each_by_itself():
    time_s = np.arange(16) / 30
    one, other = (results(Motion(seed), time_s, False) for seed in (3, 4))
    one, other = unseen(one, (3, 4)), unseen(other, range(4, 14))
    frames = [
        frame._replace(hands=pair)
        for frame, pair in zip(frames_of(one), zip(one, other, strict=True), strict=True)
    ]
    out = list(Smoother(Take(RIG, ("right", "right"), frames), Smoothing("offline"), MODELS).smooth(frames))
    assert [f.hands[0].bridged for f in out] == [index in (3, 4) for index in range(16)]
    assert not any(f.hands[1].bridged for f in out)
    assert sum(f.hands[1].reason is not None for f in out) == 10


def test_a_live_picture_waits_for_nothing():
    """Frame by frame; and what is yet to come changes nothing."""
    frames = frames_of(unseen(results(Motion(5), np.arange(14) / 30, False, 0.002), (7,)))
    taken = []

    def source():
        for frame in frames:
            taken.append(frame.name)
            yield frame

    whole = []
    for frame in Smoother(Take(RIG, ("right",), frames), Smoothing("causal"), MODELS).smooth(source()):
        assert taken[-1] == frame.name
        whole.append(frame.hands[0])
    part = smoothed(frames[:10], "causal")
    np.testing.assert_array_equal(joints_of(whole[:10]), joints_of(part))


def test_offline_holds_few_frames():
    """However long the take is; a gap adds no more than it lasts."""
    hands = unseen(results(Motion(5), np.arange(40) / 30, False), range(20, 26))
    taken = 0

    def source():
        nonlocal taken
        for frame in frames_of(hands):
            taken += 1
            yield frame

    take = Take(RIG, ("right",), ())
    given = enumerate(Smoother(take, Smoothing("offline"), MODELS).smooth(source()))
    assert max(taken - index for index, _ in given) <= 20


def test_offline_nothing_is_late():
    """A slow hand, whose every step is less than the noise: late if one looks back only."""
    rest = results(Motion(6, pace=0.0), np.zeros(1), False)[0]
    steps = 0.001 * np.arange(45)[:, None] * np.array([1, 0, 0], np.float32)
    names = ("vertices_world", "joints_world", "root_world")
    hands = [rest._replace(**{name: getattr(rest, name) + step for name in names}) for step in steps]
    trembling = 0.003 * np.random.default_rng(0).normal(size=(45, 21, 3)).astype(np.float32)
    seen = [h._replace(joints_world=h.joints_world + off) for h, off in zip(hands, trembling, strict=True)]
    late = {
        mode: float(np.mean((joints_of(hands) - joints_of(smoothed(frames_of(seen), mode)))[15:-12, :, 0]))
        for mode in MODES
    }
    assert late["causal"] > 0.002
    assert abs(late["offline"]) < 0.3 * late["causal"]


@pytest.mark.parametrize("mode", MODES)
def test_moving_the_world_moves_the_hands(mode):
    hands = unseen(results(Motion(7), np.arange(14) / 30, False, 0.002), (9, 10))
    R, t = Rotation.random(rng=1), np.array([0.5, 1.0, -0.3])

    def moved(hand: HandResult) -> HandResult:
        names = ("vertices_world", "joints_world", "root_world")
        if hand.reason is not None:
            return hand
        return hand._replace(**{n: (R.apply(getattr(hand, n)) + t).astype(np.float32) for n in names})

    one = smoothed(frames_of([moved(hand) for hand in hands]), mode)
    other = [moved(hand) for hand in smoothed(frames_of(hands), mode)]
    for name in ("vertices_world", "joints_world", "root_world"):
        np.testing.assert_allclose(
            *(np.stack([getattr(h, name) for h in many]) for many in (one, other)), atol=2e-5
        )


def test_a_bridged_hand_has_no_reprojection_error():
    hands = unseen(results(Motion(2), np.arange(9) / 30, False), (4,))
    frames = [f._replace(keypoints_px=np.full((1, 3, 21, 2), 50.0)) for f in frames_of(hands)]
    out = Smoother(Take(RIG, ("right",), frames), Smoothing("offline"), MODELS).smooth(frames)
    errors = [frame.hands[0].reprojection_px for frame in judge_hands(out, RIG)]
    assert np.isnan(errors[4]).all()
    assert np.isfinite(errors[5]).any()


def test_frames_without_times_go_at_the_rate_of_video():
    hands = results(Motion(0), np.arange(4) / 30, False)
    np.testing.assert_allclose(times_of(frames_of(hands)), np.arange(4) / 30)
    assert times_of(frames_of(hands, [5.0, 6.0, 6.5, 9.0])).tolist() == [5.0, 6.0, 6.5, 9.0]
    assert pytest.approx(1 / 30) == SECONDS_PER_FRAME


@pytest.mark.parametrize(
    ("time_s", "said"),
    [
        ([0.0, 0.1, None, 0.3], "'0001' and no time for frame '0002'"),
        ([None, 0.1, 0.2, 0.3], "'0001' and no time for frame '0000'"),
        ([0.0, 0.1, 0.1, 0.3], "'0002' after 0.1 s"),
        ([0.0, 0.1, float("nan"), 0.3], "got nan"),
    ],
)
def test_times_that_cannot_be_right_are_refused(time_s, said):
    frames = frames_of(results(Motion(0), np.arange(4) / 30, False), time_s)
    with pytest.raises(ValueError, match=said):
        list(timed(frames))
    with pytest.raises(ValueError, match=said):
        smoothed(frames)


def test_jitter_is_the_root_mean_square_of_second_differences():
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, 9, 21, 3))
    jitter = Jitter(1)
    for index in range(9):
        jitter.add(0, index / 30, before[index], after[index])
    figures = jitter.figures()
    assert figures["jitter_before_mm"] == pytest.approx(rms_mm(np.diff(before, 2, axis=0)), abs=1e-3)
    assert figures["jitter_after_mm"] == pytest.approx(rms_mm(np.diff(after, 2, axis=0)), abs=1e-3)


def test_jitter_of_a_steady_motion_is_none_whatever_the_times():
    jitter = Jitter(1)
    assert jitter.figures() == {"jitter_before_mm": None, "jitter_after_mm": None}
    for time_s in (0.0, 0.1, 0.15, 0.4):
        joints = time_s * np.ones((21, 3))
        jitter.add(0, time_s, joints, joints)
    assert jitter.figures() == {"jitter_before_mm": 0.0, "jitter_after_mm": 0.0}


def test_the_options_of_the_commands():
    assert smoothing_of(False, False, None) == Smoothing("off")
    assert smoothing_of(True, False, None) == Smoothing("offline")
    assert smoothing_of(True, True, 0.5) == Smoothing("causal", 0.5)
    with pytest.raises(ValueError, match="--bridge goes with"):
        smoothing_of(False, False, 0.5)
    with pytest.raises(ValueError, match="0 seconds or more"):
        smoothing_of(True, False, -1.0)
