"""The live line from pictures to messages: what is sent is what the newest moments show, in order."""

import itertools
import json

import numpy as np
import pytest

from poem_jax.capture.live.line import run_line
from poem_jax.capture.live.moments import Moment
from poem_jax.capture.live.pace import Pace
from poem_jax.capture.smoothing import Smoothing
from tests.capture.live.fake_cameras import (
    PERIOD_S,
    RIG,
    FakeShots,
    fake_engine,
    planted_detector,
    true_joints,
)

AS_SEEN = Smoothing("off")


class Kept:
    """A stream that notes when what was sent."""

    def __init__(self, shots):
        self._shots, self.messages, self.at_s = shots, [], []

    def send(self, message):
        self.messages.append(json.loads(message))
        self.at_s.append(self._shots.now)


def run(num_frames=12, detect_s=0.0, fit_s=0.0, smoothing=AS_SEEN, views=range(4)):
    shots = FakeShots()
    for view in views:
        shots.plan(view, range(num_frames))
    pace, kept, asked = Pace(shots.clock, shots.begin_s), Kept(shots), []
    detector = planted_detector(shots, detect_s, asked=asked)
    frames = list(run_line(shots, RIG, detector, fake_engine(shots, fit_s), smoothing, [kept.send], pace))
    return shots, pace, kept, asked, frames


def test_the_stream_holds_the_hands_of_its_moments():
    _, pace, kept, _, frames = run()
    assert [message["moment"] for message in kept.messages] == list(range(12))
    assert len(frames) == 12
    for message in kept.messages:
        assert message["time_s"] == pytest.approx(message["moment"] * PERIOD_S, abs=1e-3)
        truth = true_joints(message["moment"] * PERIOD_S)
        for side, joints in zip(("right", "left"), truth, strict=True):
            hand = message["hands"][side]
            assert hand["valid"] is True
            assert hand["bridged"] is False
            np.testing.assert_allclose(hand["joints_world"], joints, atol=2e-5)
            assert hand["sigma_m"] == [0.001] * 21
    figures = pace.figures()
    assert (figures.offered, figures.done, figures.dropped) == (12, 12, 0)


def test_a_slow_detector_gets_the_newest_and_drops_are_counted():
    detect_s, fit_s = 2.4 * PERIOD_S, 0.3 * PERIOD_S
    shots, pace, kept, asked, _ = run(60, detect_s, fit_s)
    for at_s, seen in asked:
        newest = int((at_s - shots.begin_s + 1e-9) / PERIOD_S)
        assert set(seen.values()) == {newest}
    numbers = [message["moment"] for message in kept.messages]
    assert all(after > before for before, after in itertools.pairwise(numbers))
    figures = pace.figures()
    assert figures.done == len(numbers) == len(asked)
    assert figures.offered == numbers[-1] + 1
    assert figures.dropped == figures.offered - figures.done > figures.done / 2
    delays = [
        at_s - shots.begin_s - number * PERIOD_S for at_s, number in zip(kept.at_s, numbers, strict=True)
    ]
    assert max(delays) < detect_s + fit_s + PERIOD_S, "nothing ever waits in a queue"
    assert figures.latency_ms == pytest.approx(1000 * np.quantile(delays, (0.5, 0.95)))
    assert figures.behind_ms == pytest.approx([1000 * fit_s] * 2)


def test_the_filter_looks_back_only_and_bridges():
    """The first half of a run is the same whatever follows; hands that vanish stay a moment, marked."""
    smoothing = Smoothing("causal", 0.1)
    _, _, whole, _, _ = run(10, smoothing=smoothing)
    _, _, part, _, _ = run(5, smoothing=smoothing)
    assert whole.messages[:5] == part.messages
    shots = FakeShots()
    for view in range(4):
        shots.plan(view, range(6) if view else range(14))
    kept = Kept(shots)
    pace = Pace(shots.clock, shots.begin_s)
    list(run_line(shots, RIG, planted_detector(shots), fake_engine(), smoothing, [kept.send], pace))
    hands = [message["hands"]["left"] for message in kept.messages]
    assert [hand["bridged"] for hand in hands] == [False] * 6 + [True] * 3 + [False] * (len(hands) - 9)
    assert [hand["valid"] for hand in hands] == [True] * 9 + [False] * (len(hands) - 9)
    assert hands[7]["joints_world"] == hands[5]["joints_world"]
    assert hands[7]["sigma_m"] is None
    assert hands[-1] == {"valid": False, "bridged": False, "joints_world": None, "sigma_m": None}


def test_one_camera_places_no_hand_and_the_line_goes_on():
    _, pace, kept, _, _ = run(views=(2,))
    assert not any(hand["valid"] for message in kept.messages for hand in message["hands"].values())
    assert pace.figures().done == 12


def test_hands_on_which_no_two_cameras_agree_are_told_once(caplog):
    shots = FakeShots()
    for view in range(4):
        shots.plan(view, range(32))
    # Each camera sees another place: their rays do not meet.
    wrong = RIG._replace(T_cam_from_world=RIG.T_cam_from_world[[1, 0, 3, 2]])
    pace = Pace(shots.clock, shots.begin_s)
    list(run_line(shots, wrong, planted_detector(shots), fake_engine(), AS_SEEN, [], pace))
    told = [record.message for record in caplog.records if "agree" in record.message]
    assert len(told) == 1
    assert "check the calibration" in told[0]


def test_laps_and_their_words():
    shots = FakeShots()
    pace = Pace(shots.clock, shots.begin_s)
    assert str(pace.figures()) == "0 moments, none done"
    laps = []
    for number in range(300):
        shots.now = shots.begin_s + (2 * number + 1) * PERIOD_S
        pace.begin(Moment(2 * number, 2 * number * PERIOD_S, (), min(number, 1)))
        pace.detected()
        pace.done(2 * number * PERIOD_S)
        laps += [figures for figures in [pace.lap(6.0)] if figures is not None]
    assert len(laps) == 3
    assert pace.figures().offered == 599
    assert pace.figures().dropped == 299
    assert all(lap.rate == pytest.approx(15, abs=0.5) for lap in laps)
    assert all(lap.latency_ms == pytest.approx((1000 * PERIOD_S,) * 2) for lap in laps)
    assert str(laps[1]).startswith("15.0 moments/s; 90 of 180 done, 90 dropped; latency 33 ms")
