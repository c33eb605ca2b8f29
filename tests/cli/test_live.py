"""`poem live` from its arguments to its end, with planted cameras, detector and engine."""

import json
import os
import signal
import socket

import pytest

import poem_jax.detection
from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture.live import line as line  # Before the names in its annotations are replaced.
from poem_jax.capture.live import newest, sources
from poem_jax.cli import main
from poem_jax.cli.live import Live
from tests.capture.live.fake_cameras import RIG, FakeShots, fake_engine, planted_detector


class FakeSource:
    """Gives pictures by a clock that stands still while nobody waits."""

    closed = False

    def __init__(self, num_frames):
        self._num_frames = num_frames

    def start(self, shots):
        for view in range(RIG.num_views):
            shots.plan(view, range(self._num_frames))

    def close(self):
        self.closed = True


@pytest.fixture
def planted(monkeypatch, tmp_path):
    """Arguments of a run; `planted(num_frames, at)` calls `at(number)` before each moment."""

    def prepare(num_frames=6, at=lambda number: None):
        shots, source = FakeShots(), FakeSource(num_frames)
        detect = planted_detector(shots)

        class Trackers:
            def __init__(self, num_cameras):
                assert num_cameras == RIG.num_views

            def find_hands(self, views, images):
                at(int(images[0][0, 0, 0]))
                return detect(views, images)

        monkeypatch.setattr(newest, "NewestShots", lambda num_views: shots)
        monkeypatch.setattr(sources, "open_source", lambda texts, rig, loop: source)
        monkeypatch.setattr(poem_jax.detection, "compile_programs", lambda: None)
        monkeypatch.setattr(poem_jax.detection, "HandTrackers", Trackers)
        monkeypatch.setattr(Live, "_engine", lambda self, rig: fake_engine())
        write_rig(tmp_path / "rig.json", RIG)
        return source, ["live", "--rig", str(tmp_path / "rig.json"), "--source", "folder", "--viewer", "0"]

    return prepare


def test_a_run_sends_its_moments_and_ends_with_a_summary(planted, capsys):
    source, arguments = planted()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(20)
        assert main([*arguments, "--udp", f"127.0.0.1:{receiver.getsockname()[1]}"]) == 0
        got = [json.loads(receiver.recv(65535)) for _ in range(6)]
    assert [one["moment"] for one in got] == list(range(6))
    assert all(hand["valid"] for one in got for hand in one["hands"].values())
    assert "6 of 6 done, 0 dropped; latency" in capsys.readouterr().out
    assert source.closed


@pytest.mark.parametrize(("kind", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_it_with_a_summary(planted, capsys, kind, code):
    source, arguments = planted(10, lambda number: number == 3 and os.kill(os.getpid(), kind))
    assert main(arguments) == code
    said = capsys.readouterr()
    assert "3 of 4 done, 1 dropped" in said.out
    assert f"poem: stopped by {kind.name}" in said.err
    assert source.closed


def test_it_ends_after_so_many_seconds(planted, capsys):
    _, arguments = planted(30)
    assert main([*arguments, "--seconds", "0.12"]) == 0
    assert "5 of 5 done" in capsys.readouterr().out


def test_a_port_in_use_and_other_wrong_options(planted, capsys):
    _, arguments = planted()
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = str(server.getsockname()[1])
        for option in ("--websocket", "--viewer"):
            assert main([*arguments, option, port]) == 2
            assert f"port {port} of 127.0.0.1 cannot be used" in capsys.readouterr().err
    assert main([*arguments, "--seconds", "0"]) == 2
    assert main([*arguments, "--udp", "nowhere"]) == 2
    assert capsys.readouterr().err.count("poem: error: --") == 2
