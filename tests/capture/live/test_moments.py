"""Moments of running cameras: the newest, together, in order, and every one that went by counted."""

import itertools
import logging
import threading
import time

import numpy as np
import pytest

from poem_jax.capture.live.moments import TOGETHER, LiveMoments
from poem_jax.capture.live.newest import NewestShots, Shot
from tests.capture.live.fake_cameras import PERIOD_S, FakeShots, picture

NAMES = ("a", "b", "c", "d")


def numbers(moment):
    return [None if image is None else int(image[0, 0, 0]) for image in moment.images]


def worked(shots, work_s):
    """The moments, each with the time when it was taken, by a line that works so long on each."""
    taken = []
    for moment in LiveMoments(shots, NAMES):
        taken.append((shots.now, moment))
        shots.work(work_s)
    return taken


@pytest.mark.parametrize("periods", [0.0, 0.4, 1.0, 2.3, 7.5])
def test_the_newest_is_worked_on_and_the_others_are_counted(periods):
    shots = FakeShots()
    for view in range(4):
        shots.plan(view, range(60), phase_s=0.001 * view)
    taken = worked(shots, periods * PERIOD_S)
    for at_s, moment in taken:
        newest = min(int((at_s - shots.begin_s - 0.003 + 1e-9) / PERIOD_S), 59)
        assert numbers(moment) == [newest] * 4
        assert moment.number == newest
    moments = [moment for _, moment in taken]
    assert sum(1 + moment.dropped for moment in moments) == moments[-1].number + 1
    assert len(moments) == pytest.approx(60 / max(periods, 1.0), abs=1.01)
    if periods <= 1.0:
        assert all(moment.dropped == 0 for moment in moments)


def test_no_moment_is_of_the_past_whatever_the_cameras_do():
    """Rates, phases and gaps of every kind: times and numbers grow, and pictures of a moment are together."""
    rng = np.random.default_rng(0)
    for trial in range(12):
        shots = FakeShots()
        for view in range(4):
            period_s = PERIOD_S * rng.choice([1.0, 1.0, 1.03, 2.0])
            kept = np.flatnonzero(rng.random(30) > rng.choice([0.0, 0.3])).tolist()
            late_s = rng.choice([0.0, 0.02])
            shots.plan(view, kept, period_s, rng.uniform(0, PERIOD_S), late_s)
        moments = [moment for _, moment in worked(shots, rng.uniform(0, 3) * PERIOD_S)]
        assert len(moments) > 5, trial
        for before, after in itertools.pairwise(moments):
            assert after.time_s > before.time_s
            assert after.number == before.number + 1 + after.dropped


def test_pictures_of_a_moment_lie_within_half_a_period():
    shots = FakeShots()
    phases = [0.0, 0.3, 0.55, 0.9]
    for view, phase in enumerate(phases):
        shots.plan(view, range(40), phase_s=phase * PERIOD_S)
    taken = worked(shots, 0.0)
    for _, moment in taken:
        times = [n + phases[v] for v, n in enumerate(numbers(moment)) if n is not None]
        assert max(times) - min(times) <= TOGETHER + 0.06
    assert max(sum(n is not None for n in numbers(moment)) for _, moment in taken) == 3


def test_a_moment_waits_for_the_last_camera_and_not_for_ever():
    shots = FakeShots()
    for view in range(3):
        shots.plan(view, range(30))
    shots.plan(3, [n for n in range(30) if n % 5], late_s=0.3 * PERIOD_S)
    for at_s, moment in worked(shots, 0.0):
        number = moment.number
        waited = (at_s - shots.begin_s) / PERIOD_S - number
        if number % 5 == 0 and number < 25:
            assert numbers(moment) == [number] * 3 + [None]
            assert waited == pytest.approx(TOGETHER, abs=0.05)
        elif number < 25:
            assert numbers(moment) == [number] * 4
            assert waited == pytest.approx(0.3, abs=0.01)


def test_a_camera_that_stops_is_told_once_and_unseen(caplog):
    shots = FakeShots()
    for view in range(3):
        shots.plan(view, range(200))
    shots.plan(3, range(20), ends=False)
    with caplog.at_level(logging.WARNING):
        taken = worked(shots, 0.0)
    (told,) = [record.message for record in caplog.records]
    assert told.startswith("camera 'd' gave no picture for")
    assert all(numbers(moment)[3] is None for _, moment in taken if moment.number >= 20)
    assert len(taken) == 200
    late = [at_s - shots.begin_s - m.number * PERIOD_S for at_s, m in taken if m.number > 120]
    assert max(late) < 1e-6, "nobody waits for a camera that has stopped"


def test_a_camera_comes_back(caplog):
    shots = FakeShots()
    for view in range(3):
        shots.plan(view, range(200))
    shots.plan(3, [*range(20), *range(120, 200)])
    with caplog.at_level(logging.WARNING):
        taken = worked(shots, 0.0)
    assert [record.message for record in caplog.records][1:] == ["camera 'd' is back"]
    assert numbers(taken[-1][1]) == [199] * 4
    assert len(taken) == 200


def test_the_line_ends_with_the_last_camera(caplog):
    """Whether it says so, or falls silent."""
    shots = FakeShots()
    shots.plan(0, range(10))
    shots.plan(1, range(10), ends=False)
    shots.end(2)
    shots.end(3)
    taken = worked(shots, 0.0)
    assert len(taken) == 10
    assert [record.message[:10] for record in caplog.records] == ["camera 'b'"]
    assert 2.0 < shots.now - shots.begin_s < 4.0
    assert worked(FakeShots(), 0.0) == [], "cameras that never give a picture"


def test_the_newest_replaces_the_one_before_and_wakes_who_waits():
    """By the real clock and a real thread."""
    shots = NewestShots(1)
    shots.put(0, Shot(0, shots.clock(), picture(0)))
    shots.put(0, Shot(1, shots.clock() + 0.01, picture(1)))
    states = shots.states()
    assert states[0].shot is not None
    assert states[0].shot.number == 1
    thread = threading.Timer(0.05, shots.end, (0,))
    thread.start()
    start = time.monotonic()
    shots.wait(states, 20.0)
    assert time.monotonic() - start < 10.0
    assert shots.states()[0].ended
    shots.wait(states, 20.0)
    thread.join()
