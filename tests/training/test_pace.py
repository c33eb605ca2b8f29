"""Only the time in which the devices had nothing to do counts as waiting for data."""

import threading
import time

import pytest

from poem_jax.training import pace as pace_module
from poem_jax.training.pace import Pace, peak_memory_mb


class Running:
    """A result that is not there before `end`."""

    def __init__(self):
        self.end = threading.Event()

    def block_until_ready(self):
        assert self.end.wait(10)
        return self


@pytest.fixture
def pace():
    with Pace() as pace:
        yield pace


def test_waiting_while_a_step_runs_costs_nothing(pace):
    step = Running()
    pace.started(step, 8)
    with pace.waiting():
        time.sleep(0.2)
    step.end.set()
    reading = pace.read()
    assert reading["data_wait_share"] == 0
    assert 0 < reading["steps_per_second"] < 1 / 0.2
    assert reading["samples_per_second"] == pytest.approx(8 * reading["steps_per_second"])


def test_waiting_counts_from_the_end_of_the_step(pace):
    step = Running()
    pace.started(step, 8)
    with pace.waiting():
        time.sleep(0.3)
        step.end.set()
        time.sleep(0.3)
    assert 0.35 < pace.read()["data_wait_share"] < 0.65


def test_the_first_batch_and_what_comes_after_the_step_are_waited_for(pace):
    with pace.waiting():
        time.sleep(0.2)
    assert pace.read()["data_wait_share"] > 0.8
    step = Running()
    step.end.set()
    pace.started(step, 1)
    time.sleep(0.1)
    with pace.waiting():
        time.sleep(0.1)
    assert 0.3 < pace.read()["data_wait_share"] < 0.7
    assert pace.read()["data_wait_share"] == 0


def test_what_goes_wrong_on_the_devices_arrives(pace):
    class Broken:
        def block_until_ready(self):
            raise RuntimeError("device lost")

    pace.started(Broken(), 1)
    with pytest.raises(RuntimeError, match="device lost"), pace.waiting():
        time.sleep(0.3)


def test_memory_is_that_of_the_fullest_device_or_of_the_process(monkeypatch):
    class Device:
        def __init__(self, stats):
            self.memory_stats = lambda: stats

    def devices(*stats):
        monkeypatch.setattr(pace_module.jax, "local_devices", lambda: [Device(each) for each in stats])

    devices({"peak_bytes_in_use": 3_000_000}, {"peak_bytes_in_use": 5_000_000})
    assert peak_memory_mb() == 5
    devices(None, {})
    block = bytearray(50_000_000)
    assert 50 < peak_memory_mb() < 1e6
    del block
