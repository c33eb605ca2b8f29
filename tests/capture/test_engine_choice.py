"""Which engine is taken: the one that is right in views it was not given, whatever it says of its own."""

import numpy as np
import pytest

from poem_jax.capture.engine_choice import (
    SAMPLE_FRAMES,
    choose_engine,
    plan_trials,
    sample_frames,
    seen_hands,
)
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.take import Take
from poem_jax.data.lens import project_raw
from poem_jax.geometry.rig import Rig
from tests.rigs import look_at, small_rig

FRAMES = 12


def close_rig() -> Rig:
    """Four cameras side by side, which leave the depth open, without lenses."""
    places = [[0.6, 0.03 * i, 0.2] for i in range(3)] + [[0.1, 0.6, 0.2]]
    T = np.stack([look_at(np.array(place), np.zeros(3)) for place in places])
    K = np.tile([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]], (4, 1, 1))
    return Rig(tuple("abcd"), np.array([[640, 480]] * 4), K, np.zeros((4, 5)), T)


def observed(rig: Rig, sides=("right",), noise_px=0.0, frames=FRAMES):
    """Return a take of hands somewhere near the origin, and their joints by the name of the frame."""
    rng = np.random.default_rng(3)
    truth, stored = {}, []
    for index in range(frames):
        joints = rng.uniform(-0.05, 0.05, (len(sides), 21, 3))
        uv = np.stack([[project_raw(rig, v, hand)[0] for v in range(rig.num_views)] for hand in joints])
        uv = uv + noise_px * rng.normal(size=uv.shape)
        boxes = np.concatenate([uv.min(-2), uv.max(-2)], -1)
        name = f"{index:04d}"
        truth[name] = joints
        stored.append(Frame(name, boxes, uv, image_files=(None,) * rig.num_views))
    return Take(rig, tuple(sides), stored), truth


def engine(answer, sigma_m=0.001):
    """Make an engine of a function from a frame, and which of its hands, to joints or None."""

    def find(frames, take):
        for frame in frames:
            hands = []
            for index, seen in enumerate(seen_hands(frame)):
                joints = answer(frame, index)
                if joints is None:
                    hands.append(HandResult(seen, "lost"))
                else:
                    hands.append(HandResult(seen, joints_world=joints, joint_sigma_m=np.full(21, sigma_m)))
            yield frame._replace(hands=tuple(hands))

    return find


def choice_of(take, engines):
    sample, take = sample_frames(take)
    return choose_engine(take, sample.frames, engines)


@pytest.mark.parametrize("first", ["fit", "poem"])
def test_an_engine_that_is_off_loses(first):
    """Whichever of the two it is, and however sure it is of itself."""
    take, truth = observed(small_rig(), ("right", "left"))
    right = engine(lambda frame, hand: truth[frame.name][hand] + 1e-4, sigma_m=0.01)
    biased = engine(lambda frame, hand: truth[frame.name][hand] + [0.006, 0, 0], sigma_m=1e-6)
    second = {"fit": "poem", "poem": "fit"}[first]
    choice = choice_of(take, {first: right, second: biased})
    assert choice.engine == first
    assert choice.by == "views left out"
    assert choice.figures[first]["left_out_px"] < 0.2 < 1 < choice.figures[second]["left_out_px"]
    assert first in choice.why
    assert second in choice.why
    assert len(choice.frames) == SAMPLE_FRAMES


def linear_triangulation(rig, uv):
    """The points nearest to all rays through the key points of the views that are given."""
    A, b = np.zeros((21, 3, 3)), np.zeros((21, 3))
    for view in np.flatnonzero(np.isfinite(uv).all((-2, -1))):
        R, t = rig.T_cam_from_world[view, :3, :3], rig.T_cam_from_world[view, :3, 3]
        rays = np.concatenate([uv[view], np.ones((21, 1))], -1) @ np.linalg.inv(rig.K[view]).T @ R
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None]
        A += across
        b += across @ (-R.T @ t)
    return np.linalg.solve(A, b[..., None])[..., 0]


def own_error_px(take, find):
    """Median reprojection error in all views, every one of them given."""
    errors = []
    for given, found in zip(take.frames, find(take.frames, take), strict=True):
        for view in range(take.rig.num_views):
            at = project_raw(take.rig, view, found.hands[0].joints_world)[0]
            errors.append(np.linalg.norm(at - given.keypoints_px[0, view], axis=-1))
    return np.median(errors)


def test_an_engine_that_only_explains_what_it_is_given_loses():
    """Its reprojection error in its own views is the smaller one, and must not decide."""
    rig = close_rig().select(["a", "b", "c"])
    take, truth = observed(rig, noise_px=2.0)
    overfitted = engine(lambda frame, hand: linear_triangulation(rig, frame.keypoints_px[hand]))
    rng = np.random.default_rng(0)
    honest = engine(lambda frame, hand: truth[frame.name][hand] + 5e-4 * rng.normal(size=(21, 3)))
    assert own_error_px(take, overfitted) < 0.9 * own_error_px(take, honest)
    assert choice_of(take, {"fit": overfitted, "poem": honest}).engine == "poem"


def test_engines_are_not_given_the_view_that_judges_them():
    """Key points, boxes and images of it are gone, in every frame that is tried together."""
    take, truth = observed(small_rig())
    calls = []

    def find(frames, take):
        frames = list(frames)
        hidden = {tuple(np.isnan(frame.keypoints_px).all((0, 2, 3))) for frame in frames}
        assert len(hidden) == 1
        (hidden,) = hidden
        assert sum(hidden) == 1
        view = hidden.index(True)
        calls.extend((frame.name, view) for frame in frames)
        for frame in frames:
            assert np.isnan(frame.boxes_px[:, view]).all()
            assert frame.image_files[view] is None
            assert frame.images[view] is None
        yield from engine(lambda frame, hand: truth[frame.name][hand])(frames, take)

    pictures = tuple(np.zeros((2, 2, 3), np.uint8) for _ in range(3))
    frames = [frame._replace(image_files=("x",) * 3, images=pictures) for frame in take.frames]
    choice = choice_of(take._replace(frames=frames), {"fit": find})
    assert choice.figures["fit"]["left_out_px"] < 1e-9
    assert len(calls) == len(set(calls)) == SAMPLE_FRAMES
    assert {view for _, view in calls} == {0, 1, 2}


def test_lost_hands_count_against_an_engine():
    """It is perfect where it finds a hand, and finds one in three."""
    take, truth = observed(small_rig())
    picky = engine(lambda frame, hand: truth[frame.name][hand] if int(frame.name) % 3 == 0 else None)
    plain = engine(lambda frame, hand: truth[frame.name][hand] + 0.003)
    choice = choice_of(take, {"fit": picky, "poem": plain})
    assert choice.engine == "poem"
    assert choice.figures["fit"]["left_out_px"] is None
    assert choice.figures["fit"]["hands_lost"] >= 0.5
    assert choice.figures["poem"]["hands_lost"] == 0


def test_the_detectors_habits_are_not_held_against_the_engine_that_does_not_know_them():
    """Key points lie 8 mm beside the joints; the fit knows, and both have the same hand."""
    rig = small_rig()
    take, seen = observed(rig)
    habit = np.array([0.008, 0, 0])

    def fit(frames, take):
        for frame in engine(lambda frame, hand: seen[frame.name][hand] - habit)(frames, take):
            hands = tuple(hand._replace(expected_world=hand.joints_world + habit) for hand in frame.hands)
            yield frame._replace(hands=hands)

    poem = engine(lambda frame, hand: seen[frame.name][hand] - habit)
    figures = choice_of(take, {"fit": fit, "poem": poem}).figures
    assert figures["poem"]["left_out_px"] == pytest.approx(figures["fit"]["left_out_px"], abs=1e-9)


def test_two_views_leave_the_engines_own_uncertainty():
    take, truth = observed(small_rig().select(["front", "cam 3"]))
    sure = engine(lambda frame, hand: truth[frame.name][hand], sigma_m=0.002)
    doubtful = engine(lambda frame, hand: truth[frame.name][hand], sigma_m=0.007)
    for names in (("fit", "poem"), ("poem", "fit")):
        choice = choice_of(take, dict(zip(names, (sure, doubtful), strict=True)))
        assert choice.engine == names[0]
        assert choice.by == "uncertainty"
        assert choice.figures[names[1]]["sigma_mm"] == pytest.approx(7)
        assert "no hand is seen by three views" in choice.why


def test_each_view_has_its_turn_and_the_work_is_bounded():
    for frames in (1, 3, 30):
        sample, _ = sample_frames(observed(small_rig(), frames=frames)[0])
        trials = plan_trials(sample.frames)
        pairs = {(trial.frame.name, trial.view) for trial in trials}
        assert len(pairs) == len(trials) == min(3 * frames, SAMPLE_FRAMES)
        assert {view for _, view in pairs} == {0, 1, 2}


def test_a_view_that_sees_no_hand_is_not_left_out():
    take, _ = observed(close_rig())
    frames = [frame._replace(boxes_px=frame.boxes_px.copy()) for frame in take.frames]
    for frame in frames:
        frame.boxes_px[:, 1] = np.nan
    assert {trial.view for trial in plan_trials(frames)} == {0, 2, 3}


def test_frames_are_spread_and_a_stream_stays_whole():
    take, _ = observed(small_rig(), frames=30)
    sample, again = sample_frames(take)
    assert [int(frame.name) for frame in sample.frames] == [0, 4, 8, 12, 17, 21, 25, 29]
    assert again is take
    stream = take._replace(frames=iter(take.frames))
    sample, rest = sample_frames(stream)
    assert [int(frame.name) for frame in sample.frames] == list(range(SAMPLE_FRAMES))
    assert [frame.name for frame in rest.frames] == [frame.name for frame in take.frames]


def test_frames_that_show_more_are_preferred():
    take, _ = observed(small_rig())
    frames = [frame._replace(boxes_px=frame.boxes_px.copy()) for frame in take.frames]
    for frame in frames[:8]:
        frame.boxes_px[:, 0] = np.nan
    sample, _ = sample_frames(take._replace(frames=frames))
    assert [int(frame.name) for frame in sample.frames] == [8, 9, 10, 11]
