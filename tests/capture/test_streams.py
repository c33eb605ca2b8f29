"""A source of unknown length: memory stays flat, and an early end leaves what was done."""

import json
import signal
import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest

from poem_jax.batch import Prediction
from poem_jax.capture import agreement
from poem_jax.capture.network import Network
from poem_jax.capture.outputs import page
from poem_jax.capture.pipeline import reconstruct
from poem_jax.capture.take import read_take
from poem_jax.hand.template import default_hand
from poem_jax.models.config import Config
from poem_jax.models.infer import Prepared


def flat_network(stop=None):
    """A network that gives every hand the same mesh, at no cost; raises at its second batch, if so wished."""
    hand = default_hand()
    calls = []

    def answer(_, views, cams):
        calls.append(len(views))
        if stop is not None and len(calls) == 2:
            raise stop
        number = len(views)
        return Prediction(
            np.tile(hand.v_template / 2, (number, 1, 1)),
            np.zeros((number, 21, 3)),
            np.zeros((number, 3)),
            np.full((*views.shape[:2], 1, 2), 32.0),
            np.zeros((number, 1, 799, 3)),
            cams.view_mask.any(-1),
        )

    params = {"constants": {"hand": hand._asdict()}}
    return Network(Config(image_hw=(64, 64)), Prepared(params, None, Config()), "stub", answer)


def endless(take, count=None, at_frame=lambda index: None):
    """The first frame of a take again and again, of which nobody knows how often."""
    (first, *_) = take.frames
    index = 0
    while count is None or index < count:
        at_frame(index)
        yield first._replace(name=f"{index:05d}")
        index += 1


def frames_of(path):
    with np.load(path) as stored:
        return stored["frames"].tolist()


@pytest.mark.slow
def test_memory_does_not_grow_with_the_take(make_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "PAGE_FRAMES", 2)
    monkeypatch.setattr(agreement, "_WINDOW", 8)
    take = read_take(make_capture().folder)
    held = {}

    def measure(index):
        held[index] = tracemalloc.get_traced_memory()[0]

    endless_take = take._replace(frames=endless(take, 61, measure))
    assert endless_take.num_frames is None
    tracemalloc.start()
    try:
        reconstruct(endless_take, tmp_path / "out", network=flat_network(), progress=False)
    finally:
        tracemalloc.stop()
    # A mesh has 9 kB, the three images of a frame 390 kB; names and entries of files are smaller.
    assert held[56] - held[24] < 32 * 6_000
    assert len(frames_of(tmp_path / "out" / "prediction.npz")) == 61
    assert json.loads((tmp_path / "out" / "report.json").read_text())["solved_hands"] == 61


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), OSError("the disk is gone")])
def test_what_was_done_is_left(make_capture, tmp_path, caplog, stop):
    take = read_take(make_capture().folder)
    take = take._replace(frames=endless(take, 9))
    out = tmp_path / "out"
    with pytest.raises(type(stop)):
        reconstruct(take, out, network=flat_network(stop), progress=False)
    # Frames go through the network four at a time.
    assert frames_of(out / "prediction.npz") == ["00000", "00001", "00002", "00003"]
    report = json.loads((out / "report.json").read_text())
    assert report["stopped_by"] == type(stop).__name__
    assert report["num_frames"] == 4
    assert (out / "hands.glb").is_file()
    assert "holds the first 4 frames" in caplog.text


def test_a_stop_within_the_first_frame_leaves_the_report(make_capture, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(page.PageFrames, "offer", stop)
    take = read_take(make_capture().folder)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        reconstruct(take, out, network=flat_network(), progress=False)
    assert json.loads((out / "report.json").read_text())["stopped_by"] == "KeyboardInterrupt"
    assert not (out / "index.html").exists()


def test_nothing_is_left_where_nothing_was_done(make_capture, tmp_path):
    def at_frame(index):
        raise KeyboardInterrupt

    take = read_take(make_capture().folder)
    take = take._replace(frames=endless(take, None, at_frame))
    with pytest.raises(KeyboardInterrupt):
        reconstruct(take, tmp_path / "out", network=flat_network(), progress=False)
    assert not (tmp_path / "out").exists()


def test_a_killed_fit_leaves_a_readable_prediction(tmp_path):
    """Killed while it runs, without any chance to clean up."""
    code = """
import sys, time
import numpy as np
from poem_jax.io import growing_npz
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.write import Style, write_results
from poem_jax.capture.report import Clock
from poem_jax.capture.take import Take
from poem_jax.geometry.rig import Rig
from pathlib import Path

growing_npz.FLUSH_SECONDS = 0.0
rig = Rig(("a",), np.array([[64, 48]]), np.diag([50.0, 50, 1])[None], np.zeros((1, 5)), np.eye(4)[None])

def frames():
    points = {"vertices_world": (778, 3), "joints_world": (21, 3), "root_world": (3,)}
    arrays = {name: np.ones(shape) for name, shape in points.items()}
    hand = HandResult(np.ones(1, bool), reprojection_px=np.ones(1), joints_shown=np.ones(1), **arrays)
    while True:
        yield Frame(f"{time.monotonic_ns()}", np.ones((1, 1, 4)), hands=(hand,))

faces = {"right": np.array([[0, 1, 2]]), "left": np.array([[0, 2, 1]])}
style = Style(faces, False, True, np.zeros(3))
write_results(frames(), Take(rig, ("right",), []), Path(sys.argv[1]), style, Clock(), {})
"""
    out = tmp_path / "out"
    process = subprocess.Popen([sys.executable, "-c", code, str(out)])
    try:
        deadline = time.monotonic() + 60
        while not (out / "prediction.npz").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.3)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    count = len(frames_of(out / "prediction.npz"))
    assert count > 0
    with np.load(out / "prediction.npz") as stored:
        assert all(len(stored[name]) == count for name in ("vertices_world", "joints_world", "valid"))
        assert (stored["vertices_world"] == 1).all()
