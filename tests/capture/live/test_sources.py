"""What pictures come from: takes played at their rate, and cameras of which OpenCV gives what a test says."""

import time

import cv2
import numpy as np
import pytest

from poem_jax.capture.live import cameras
from poem_jax.capture.live.moments import LiveMoments
from poem_jax.capture.live.newest import NewestShots
from poem_jax.capture.live.sources import open_source
from tests.rigs import small_rig
from tests.videos import number_of, write_video

RIG = small_rig()._replace(names=("a", "b", "c"), size_wh=np.array([[64, 48]] * 3))
RATE = 20


class FakeCapture:
    """A camera of OpenCV that gives so many pictures of a size."""

    def __init__(self, count=5, size_wh=(64, 48), opened=True):
        self.count, self.size_wh, self._opened, self.released, self.asked = count, size_wh, opened, False, {}

    def isOpened(self):
        return self._opened

    def set(self, what, value):
        self.asked[what] = value
        return True

    def read(self):
        time.sleep(0.01)
        self.count -= 1
        if self.count < 0:
            return False, None
        image = np.zeros((self.size_wh[1], self.size_wh[0], 3), np.uint8)
        image[..., 2] = 200
        return True, image

    def release(self):
        self.released = True


def played(source):
    """All moments of a source, by a line that is always ready."""
    shots = NewestShots(RIG.num_views)
    source.start(shots)
    try:
        return list(LiveMoments(shots, RIG.names))
    finally:
        source.close()


def test_a_folder_of_videos_is_played_at_its_rate(tmp_path):
    for seed, name in enumerate("ab"):
        write_video(tmp_path / f"{name}.mp4", 8, RATE, seed=seed)
    start = time.monotonic()
    moments = played(open_source([str(tmp_path)], RIG))
    assert time.monotonic() - start > 7 / RATE
    assert len(moments) >= 2
    for moment in moments:
        assert moment.images[2] is None
        shown = [number_of(image) for image in moment.images if image is not None]
        assert shown in ([round(moment.time_s * RATE)], [round(moment.time_s * RATE)] * 2)
    assert moments[-1].time_s == pytest.approx(7 / RATE, abs=0.051)


def test_a_take_begins_again(tmp_path):
    videos = {name: write_video(tmp_path / f"{name}.mp4", 3, RATE, seed=ord(name)) for name in "ab"}
    source = open_source([f"{name}={path}" for name, path in videos.items()], RIG, loop=True)
    shots = NewestShots(RIG.num_views)
    source.start(shots)
    times = []
    for moment in LiveMoments(shots, RIG.names):
        times.append(moment.time_s)
        shown = {number_of(image) for image in moment.images if image is not None}
        assert shown == {round(moment.time_s * RATE) % 3}
        if moment.time_s > 8 / RATE:
            break
    source.close()
    assert times == sorted(times)


def test_cameras_are_asked_for_their_size_and_end(monkeypatch, caplog):
    captures = {0: FakeCapture(), 2: FakeCapture(9)}
    monkeypatch.setattr(cameras.cv2, "VideoCapture", lambda number: captures[number])
    moments = played(open_source(["a=0", "c=2"], RIG))
    assert moments
    assert all(moment.images[1] is None for moment in moments)
    image = next(image for image in moments[0].images if image is not None)
    assert image[0, 0].tolist() == [200, 0, 0], "RGB"
    assert captures[0].asked[cv2.CAP_PROP_FRAME_WIDTH] == 64
    assert captures[0].released
    assert captures[2].released
    told = sorted(record.message for record in caplog.records)
    assert told == [f"camera '{name}' delivers no more: unseen" for name in "ac"]


@pytest.mark.parametrize(
    ("capture", "error", "match"),
    [
        (FakeCapture(opened=False), ConnectionError, "camera 'a' cannot be opened: device 0 is not there"),
        (FakeCapture(0), ConnectionError, "camera 'a' .0. is open, but gives no picture"),
        (
            FakeCapture(9, (32, 48)),
            ValueError,
            "gives pictures of 32 x 48, and the rig was calibrated at 64 x 48",
        ),
    ],
)
def test_a_camera_that_is_of_no_use_is_one_clear_error(monkeypatch, capture, error, match):
    monkeypatch.setattr(cameras.cv2, "VideoCapture", lambda number: capture)
    with pytest.raises(error, match=match):
        open_source(["a=0", "b=1"], RIG)


@pytest.mark.parametrize(
    ("texts", "match"),
    [
        (["a=0", "x=1"], "no camera 'x' in the rig; it has a, b, c"),
        (["a=0", "a=1"], "names camera 'a' twice"),
        (["a=0", "b=0"], "the same source"),
        (["a=0", "b"], "must be a folder alone, or a=WHAT"),
        (["a=0"], "two cameras of a, b, c or more; got 1"),
        (["a=0", "b=clip.mp4"], "cameras alone or video files alone; b is a file and a is not"),
    ],
)
def test_sources_that_are_none(texts, match):
    with pytest.raises(ValueError, match=match):
        open_source(texts, RIG)


def test_a_take_without_times_and_cameras_that_should_loop(tmp_path):
    for name in "abc":
        (tmp_path / "frames" / "0").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "frames" / "0" / f"{name}.png"), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(ValueError, match=r"give their rate in sync\.json"):
        open_source([str(tmp_path)], RIG)
    with pytest.raises(ValueError, match="--loop is for a take"):
        open_source(["a=0", "b=1"], RIG, loop=True)
    with pytest.raises(FileNotFoundError):
        open_source([str(tmp_path / "nowhere")], RIG)
