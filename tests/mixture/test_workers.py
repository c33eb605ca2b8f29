"""Worker processes give what one process gives, and end with the run, whatever ends it."""

import os
import pickle
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from poem_jax.mixture import workers
from poem_jax.mixture.samples import Mixture
from poem_jax.mixture.workers import WorkerDied, Workers
from tests.mixture.fakes import FakeSamples

ROOT = Path(__file__).resolve().parents[2]
SOON = 120
"""Seconds; a worker starts in one, on a machine with nothing else to do."""


def mixture(**options) -> Mixture:
    parts = [FakeSamples("first", 40, **options), FakeSamples("second", 7)]
    return Mixture(parts, (0.6, 0.4), seed=5)


def is_gone(pid: int) -> bool:
    """Ended and waited for: a zombie still has its number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def assert_equal(one, other):
    np.testing.assert_array_equal(one.views, other.views)
    np.testing.assert_array_equal(one.joints_world, other.joints_world)
    assert one.pose is None
    assert other.pose is None


@pytest.fixture(scope="module")
def here():
    return [mixture(bad=frozenset({3})).draw(i, 4) for i in range(60)]


def test_workers_draw_what_one_process_draws_and_leave_nobody_behind(here):
    with Workers(mixture(bad=frozenset({3})), 2) as pool:
        waiting = [pool.submit(i, 4) for i in reversed(range(60))]
        drawn = [future.result(SOON) for future in reversed(waiting)]
        ids = pool.process_ids
    assert all(is_gone(pid) for pid in ids)
    for one, other in zip(drawn, here, strict=True):
        assert one.part == other.part
        assert one.skipped == other.skipped
        assert_equal(one.sample, other.sample)
        one.sample.views[...] = 0  # arrays may be written to


def test_a_killed_worker_is_named_and_ends_all_that_waits():
    with Workers(mixture(deadly=frozenset({1})), 1) as pool:
        waiting = [pool.submit(i, 4) for i in range(100)]
        errors = [future.exception(SOON) for future in waiting]
        first = next(error for error in errors if error is not None)
        assert isinstance(first, WorkerDied)
        assert re.match(r"data worker 0 \(process \d+\) ended by SIGKILL at sample \d+ .*memory", str(first))
        assert all(error is first for error in errors[errors.index(first) :])
        with pytest.raises(WorkerDied, match="SIGKILL"):
            pool.submit(0, 4)
    assert all(is_gone(pid) for pid in pool.process_ids)


def test_errors_of_samples_reach_who_asked_and_closing_waits_for_nothing_that_nobody_reads():
    pool = Workers(mixture(wrong=frozenset(range(10)), seconds=0.02), 1)
    waiting = [pool.submit(i, 4) for i in range(1000)]
    errors = [future.exception(SOON) for future in waiting[:60]]
    start = time.monotonic()
    pool.close()
    assert time.monotonic() - start < 4
    assert all(future.done() for future in waiting)
    assert is_gone(pool.process_ids[0])
    with pytest.raises(RuntimeError, match="the data workers are closed"):
        pool.submit(0, 4)
    pool.close()

    raised = [error for error in errors if error is not None]
    assert 6 <= len(raised) <= 10
    assert isinstance(raised[0], ZeroDivisionError)
    assert re.fullmatch(r"frame \d", str(raised[0]))
    assert any("fakes.py" in note for note in raised[0].__notes__)


def test_a_mixture_that_cannot_be_sent_says_so_and_leaves_nobody_behind(monkeypatch):
    started = []
    monkeypatch.setattr(
        workers, "_start", lambda start=workers._start: started.append(start()) or started[-1]
    )
    broken = mixture()
    broken.parts[0].name = lambda: "no name"
    with pytest.raises((AttributeError, pickle.PicklingError), match="pickle"):
        Workers(broken, 1)
    assert len(started) == 1
    assert is_gone(started[0].pid)


def test_workers_of_a_killed_run_end_by_themselves_and_signals_are_the_runs():
    script = (
        "import os, time\n"
        "from poem_jax.mixture.workers import Workers\n"
        "from tests.mixture.test_workers import mixture\n"
        "pool = Workers(mixture(), 1)\n"
        "pool.submit(0, 4).result()\n"
        "print(*pool.process_ids, flush=True)\n"
        "time.sleep(600)\n"
    )
    run = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    ids = [int(number) for number in run.stdout.readline().split()]
    assert len(ids) == 1
    assert all(os.getpgid(pid) != os.getpgid(run.pid) for pid in ids)
    for pid in ids:
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGTERM)
    time.sleep(0.2)
    assert not any(is_gone(pid) or _is_zombie(pid) for pid in ids)
    run.kill()
    run.wait()
    run.stdout.close()
    until = time.monotonic() + SOON
    while not all(is_gone(pid) or _is_zombie(pid) for pid in ids) and time.monotonic() < until:
        time.sleep(0.05)
    assert all(is_gone(pid) or _is_zombie(pid) for pid in ids)


def _is_zombie(pid: int) -> bool:
    """Ended, and not waited for by whoever took over the orphans of this machine."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True
