"""Several hosts train as one does, stop together, and end when one of them dies."""

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import create_autospec

import jax
import numpy as np
import pytest
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from poem_jax.training import hosts, initial_state
from poem_jax.training.config import ComputeConfig
from poem_jax.training.hosts import (
    HostLost,
    any_host,
    as_on_first_host,
    check_same_everywhere,
    is_first_host,
    names_lost_host,
    start_hosts,
    wait_for_all,
)
from poem_jax.training.loop import train
from poem_jax.training.parallel import check_batch_sizes
from poem_jax.training.source import synthetic_batches
from tests.training.one_host import MANY, config_of

ROOT = Path(__file__).resolve().parents[2]


def test_one_process_is_the_first_host_and_waits_for_nobody():
    assert is_first_host()
    assert any_host(True)
    assert not any_host(False)
    wait_for_all("nothing")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("10.0.0.1:1234", 2, None), "--host-index is missing"),
        ((None, 2, 0), "--coordinator is missing"),
        (("10.0.0.1", 2, 0), "--coordinator must be HOST:PORT, .* got '10.0.0.1'"),
        (("10.0.0.1:1234", 2, 2), "--host-index must be one of 0 to --num-hosts - 1; got 2 of 2"),
    ],
)
def test_hosts_that_are_named_badly_are_refused(given, message, monkeypatch):
    monkeypatch.setattr(jax.distributed, "initialize", lambda *_, **__: pytest.fail("too late"))
    with pytest.raises(ValueError, match=message):
        start_hosts(*given)


def test_without_a_launcher_it_is_said_how_to_name_the_hosts(monkeypatch):
    def initialize(*_, **__):
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    with pytest.raises(ValueError, match=r"JAX finds no hosts .*--coordinator HOST:PORT --num-hosts N"):
        start_hosts(None, None, None)


def test_where_a_launcher_names_the_hosts_none_is_called_none(monkeypatch):
    def initialize(*_, **__):
        raise jax.errors.JaxRuntimeError("DEADLINE_EXCEEDED: no answer")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    with pytest.raises(ConnectionError, match="this host has not found the others that its launcher names"):
        start_hosts(None, None, None)
    with pytest.raises(ConnectionError, match=r"host 1 of 2 has not found the others at 10\.0\.0\.1:1234"):
        start_hosts("10.0.0.1:1234", 2, 1)


@pytest.mark.parametrize("kind", [jax.errors.JaxRuntimeError, ValueError])
def test_a_lost_host_is_named_and_other_errors_stay(monkeypatch, kind):
    lost = kind("UNKNOWN: Gloo AllGather failed: Connection closed by peer\nmore")
    with pytest.raises(kind), names_lost_host():
        raise lost
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(hosts, "_lost", [])
    with (
        pytest.raises(HostLost, match=r"host 0 of 2 cannot go on: .*closed by peer\)\. Its own"),
        names_lost_host(),
    ):
        raise lost
    for local in (
        "RESOURCE_EXHAUSTED: out of memory",
        "INTERNAL: NCCL operation ncclCommInitRank failed: unhandled cuda error",
        "UNAVAILABLE: Error reading storage",
        "DEADLINE_EXCEEDED: reading the kernel took too long",
    ):
        with pytest.raises(kind), names_lost_host():
            raise kind(local)


def test_what_hosts_must_have_alike_is_compared(monkeypatch):
    others = [1, 0]

    def gather(own):
        return np.stack([own + np.uint8(other) for other in (0, others.pop())])

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(multihost_utils, "process_allgather", gather)
    check_same_everywhere("config", "a")
    with pytest.raises(ValueError, match=r"the same config; hosts \[1\] have another than the first one"):
        check_same_everywhere("config", "a")


@pytest.mark.parametrize(
    ("tasks", "shown", "idle"), [(1, "0,1,2,3", True), (4, "0,1,2,3", False), (4, "2", False)]
)
def test_gpus_that_no_task_takes_are_named(monkeypatch, caplog, tasks, shown, idle):
    monkeypatch.setattr(jax, "process_count", lambda: 8)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_device_count", lambda: 1)
    monkeypatch.setattr(initial_state, "count_where", lambda _: tasks)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", shown)
    initial_state._warn_of_idle_gpus()
    assert ("1 of the 4 GPUs of" in caplog.text) == idle


def test_weights_to_start_from_are_told_apart_where_there_are_several_hosts(monkeypatch):
    one, other = ({"trainable": {"weights": np.full(3, value, np.float32)}} for value in (0, 1))
    assert initial_state._digest(one) == initial_state._digest(other) == ""
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    assert initial_state._digest(one) == initial_state._digest(jax.tree.map(np.copy, one))
    assert initial_state._digest(one) != initial_state._digest(other)


def test_what_the_first_host_sees_holds_for_all(monkeypatch):
    told = []

    def broadcast(own):
        told.append(own)
        return np.int32(2) if own.ndim == 0 else np.array([4, 2], np.int32)

    assert as_on_first_host([7]) == [7]
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    monkeypatch.setattr(multihost_utils, "broadcast_one_to_all", broadcast)
    assert as_on_first_host([2]) == [4, 2]
    assert [np.shape(own) for own in told] == [(), (2,)]


def test_a_folder_that_is_not_shared_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(hosts, "wait_for_all", lambda _: None)
    monkeypatch.setattr(hosts, "any_host", lambda flag: flag)
    hosts.check_shared_folder(tmp_path, "--train.out")
    monkeypatch.setattr(hosts, "any_host", lambda flag: True)
    with pytest.raises(ValueError, match=r"is not the same on all of them; give --train.out a folder"):
        hosts.check_shared_folder(tmp_path, "--train.out")
    assert not list(tmp_path.iterdir())


def test_hosts_draw_the_blocks_of_one_hosts_batch(tmp_path):
    data = config_of(tmp_path, steps=1).data
    whole = synthetic_batches(data)(3)
    parts = [synthetic_batches(data, host=host, hosts=2)(3) for host in range(2)]
    assert not np.array_equal(parts[0].joints_world, parts[1].joints_world)
    jax.tree.map(lambda one, *rows: np.testing.assert_array_equal(one, np.concatenate(rows)), whole, *parts)


def mesh_of(*numbers: int) -> Mesh:
    """A stand-in of a mesh with a device for each of these process numbers."""
    mesh = create_autospec(Mesh, instance=True, size=len(numbers))
    mesh.devices = np.array([SimpleNamespace(process_index=number) for number in numbers])
    return mesh


def test_batches_must_split_over_the_devices_of_all_hosts(tmp_path):
    config = config_of(tmp_path, steps=1)
    check_batch_sizes(config, mesh_of(0, 0, 1, 1))
    with pytest.raises(ValueError, match=r"same number of devices; got \[2, 1\]\. Show JAX fewer on some"):
        check_batch_sizes(config, mesh_of(0, 0, 1))
    with pytest.raises(ValueError, match=r"multiple of the number of devices of all 3 hosts, 3; got \[4\]"):
        check_batch_sizes(config, mesh_of(0, 1, 2))
    halves = replace(config, compute=ComputeConfig(accumulate=2))
    check_batch_sizes(halves, mesh_of(0, 1))
    with pytest.raises(ValueError, match=r"hosts, 4, times `compute.accumulate` = 2, 8; got \[4\]"):
        check_batch_sizes(halves, mesh_of(0, 1, 2, 3))


class Hosts:
    """Two processes that train together."""

    def __init__(self, out: Path, *, steps: int) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            coordinator = f"127.0.0.1:{free.getsockname()[1]}"
        options = {"out": str(out), "steps": steps, "coordinator": coordinator, "count": 2}
        self.logs = [out.parent / f"{out.name}_host{index}.log" for index in range(2)]
        self.processes = [self._start(log, options | {"index": n}) for n, log in enumerate(self.logs)]

    def _start(self, log: Path, options: dict) -> subprocess.Popen:
        command = [sys.executable, "-m", "tests.training.one_host", json.dumps(options)]
        with log.open("w") as output:
            return subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)

    def wait_until(self, file: Path, *, seconds: float = 600.0) -> None:
        """Wait until the run has written this file."""
        end = time.monotonic() + seconds
        while not file.exists():
            codes = [process.poll() for process in self.processes]
            assert codes == [None, None], f"{codes}\n{self.said(0)}\n{self.said(1)}"
            assert time.monotonic() < end, f"{file} has not come\n{self.said(0)}"
            time.sleep(0.05)

    def said(self, index: int) -> str:
        return self.logs[index].read_text()


@contextmanager
def two_hosts(out: Path, *, steps: int) -> Iterator[Hosts]:
    pair = Hosts(out, steps=steps)
    try:
        yield pair
    finally:
        for process in pair.processes:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def sittings(tmp_path_factory) -> SimpleNamespace:
    """Two hosts of which one is killed after step 2; and two more, which go on and are told to stop by a
    signal to the second. `alone` is the run as it was at step 2."""
    folder = tmp_path_factory.mktemp("hosts")
    out, alone = folder / "two", folder / "alone"
    with two_hosts(out, steps=MANY) as pair:
        pair.wait_until(out / "seals" / "2.json")
        pair.processes[1].kill()
        start = time.monotonic()
        lost = SimpleNamespace(code=pair.processes[0].wait(120), seconds=time.monotonic() - start)
        lost.said = pair.said(0)
    for part in ("checkpoints/2", "seals/2.json", "train_config.json"):
        (alone / part).parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (out / part).is_dir() else shutil.copyfile
        copy(out / part, alone / part)
    losses = losses_in(out)
    with two_hosts(out, steps=MANY) as pair:
        pair.wait_until(out / "seals" / f"{newest(out) + 2}.json")
        pair.processes[1].send_signal(signal.SIGTERM)
        stopped = SimpleNamespace(codes=[process.wait(120) for process in pair.processes])
        stopped.said = [pair.said(index) for index in range(2)]
    return SimpleNamespace(out=out, alone=alone, losses=losses, lost=lost, stopped=stopped)


def newest(out: Path) -> int:
    return max(int(seal.stem) for seal in (out / "seals").glob("*.json"))


def losses_in(out: Path) -> dict[int, float]:
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return {line["step"]: line["loss"] for line in lines}


@pytest.mark.slow
def test_two_hosts_learn_what_one_does_and_one_goes_on_from_their_checkpoint(sittings, tmp_path):
    """The losses of four steps: of one host; of two; of two until the second, and then of one."""
    whole = config_of(tmp_path / "one", steps=4)
    train(whole)
    train(replace(whole, train=replace(whole.train, out=str(sittings.alone))))
    one = losses_in(tmp_path / "one")
    assert sorted(one) == [1, 2, 3, 4]
    for others in (sittings.losses, losses_in(sittings.alone)):
        shared = sorted(one.keys() & others.keys())
        assert len(shared) >= 2
        np.testing.assert_allclose([others[n] for n in shared], [one[n] for n in shared], rtol=1e-5)


@pytest.mark.slow
def test_a_host_whose_other_dies_ends_within_a_minute_and_says_why(sittings):
    assert sittings.lost.code == 2, sittings.lost.said
    assert sittings.lost.seconds < 60
    assert "another host has ended" in sittings.lost.said


@pytest.mark.slow
def test_a_signal_to_one_host_stops_all_after_the_same_step(sittings):
    assert sittings.stopped.codes == [0, 128 + signal.SIGTERM]
    steps = [re.findall(r"stopped after step (\d+) of", text) for text in sittings.stopped.said]
    assert steps == [[str(newest(sittings.out))]] * 2
    for text in sittings.stopped.said:
        assert "resumed at step" in text
