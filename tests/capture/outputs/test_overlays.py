"""Overlay videos: every frame at its place, and a file that is whole or not there."""

import cv2
import numpy as np
import pytest

from poem_jax.capture.outputs import overlays
from poem_jax.capture.outputs.overlays import OverlayVideos

SIZES = ((48, 64), (45, 61))


def picture(level, hw):
    return np.full((*hw, 3), (level, 60, 255 - level), np.uint8)


def read(path):
    video = cv2.VideoCapture(str(path))
    rate, frames = video.get(cv2.CAP_PROP_FPS), []
    while True:
        ok, frame = video.read()
        if not ok:
            return rate, frames
        frames.append(frame[..., ::-1])


def test_every_frame_is_at_its_place(tmp_path):
    paths = [tmp_path / "overlay_a.mp4", tmp_path / "overlay_b.mp4", tmp_path / "overlay_c.mp4"]
    videos = OverlayVideos(paths)
    for index in range(6):
        first = None if index in (0, 3) else picture(40 * index, SIZES[0])
        videos.add(index / 12.5, [first, picture(240 - 40 * index, SIZES[1]), None])
    assert not any(path.exists() for path in paths)
    assert videos.finish() == paths[:2]
    videos.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["overlay_a.mp4", "overlay_b.mp4"]
    rate, frames = read(paths[0])
    assert rate == pytest.approx(12.5)
    levels = [frame.mean((0, 1)) for frame in frames]
    for index in range(6):
        expected = [128] * 3 if index in (0, 3) else [40 * index, 60, 255 - 40 * index]
        np.testing.assert_allclose(levels[index], expected, atol=12)
    # The encoder wants even sizes, and OpenCV cuts off the odd row and column.
    assert {frame.shape for frame in read(paths[1])[1]} == {(44, 60, 3)}
    assert len(read(paths[1])[1]) == 6


@pytest.mark.parametrize("count", [0, 1])
def test_a_take_too_short_for_a_rate(tmp_path, count):
    videos = OverlayVideos([tmp_path / "overlay_a.mp4"])
    for _ in range(count):
        videos.add(None, [picture(9, SIZES[0])])
    assert len(videos.finish()) == count
    if count:
        rate, frames = read(tmp_path / "overlay_a.mp4")
        assert (rate, len(frames)) == (30, 1)


def test_what_is_not_finished_is_not_there(tmp_path):
    path = tmp_path / "overlay_a.mp4"
    path.write_text("of an earlier run")
    videos = OverlayVideos([path])
    for index in range(3):
        videos.add(index / 10, [picture(9, SIZES[0])])
    videos.close()
    assert [file.name for file in tmp_path.iterdir()] == ["overlay_a.mp4"]
    assert path.read_text() == "of an earlier run"


def test_a_video_that_lost_frames_is_not_taken_for_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(overlays, "_frames_in", lambda path: 2)
    videos = OverlayVideos([tmp_path / "overlay_a.mp4"])
    for index in range(3):
        videos.add(index / 10, [picture(9, SIZES[0])])
    with pytest.raises(OSError, match="2 of its 3 frames arrived; is the disk full"):
        videos.finish()
    videos.close()
    assert list(tmp_path.iterdir()) == []


def test_without_an_encoder_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(overlays, "_CODEC", "zzzz")
    videos = OverlayVideos([tmp_path / "overlay_a.mp4"])
    videos.add(None, [picture(9, SIZES[0])])
    with pytest.raises(OSError, match=r"OpenCV opens no zzzz video there; --formats png writes images"):
        videos.finish()
