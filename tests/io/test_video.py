"""Frames of videos by time: right ones, damaged ones, and files that are no videos."""

import numpy as np
import pytest

from poem_jax.io.video import Video, VideoFrame
from tests.videos import cut, damage, delay_frames, note_turn, number_of, picture, write_video


def numbers(video, times, within_s=0.05):
    """The frames at some times, None where there is none."""
    found = []
    for time_s in times:
        try:
            found.append(number_of(video.image_at(float(time_s), within_s)))
        except ValueError:
            found.append(None)
    return found


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv"])
def test_frames_are_found_by_time_in_any_order(tmp_path, suffix):
    video = Video(write_video(tmp_path / f"a{suffix}"))
    assert video.header.size_wh == (64, 48)
    assert video.header.last_s == pytest.approx(1.9)
    assert not video.header.is_cut_short
    order = [*range(20), 3, 19, 4, 5, 5, 0]
    assert numbers(video, [index / 10 for index in order]) == order
    assert numbers(video, [0.04, 0.06, 1.94, 2.0]) == [0, 1, 19, None]
    with pytest.raises(ValueError, match=r"a\..* has no frame within 0\.05 s of 2\.100 s: it ends before"):
        video.image_at(2.1, 0.05)


def test_a_frame_is_rgb(tmp_path):
    image = VideoFrame(Video(write_video(tmp_path / "a.avi")), 0.5, 0.05).read((64, 48))
    assert np.abs(image.astype(int) - picture(5)[..., ::-1]).mean() < 8


def test_what_is_far_ahead_is_found(tmp_path):
    video = Video(write_video(tmp_path / "a.mp4", num_frames=31, rate=0.5))
    assert numbers(video, [0, 40, 42, 60, 20], within_s=1.0) == [0, 20, 21, 30, 10]


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_damage_costs_the_frames_that_it_hits(tmp_path, suffix):
    damage(write_video(tmp_path / f"a{suffix}", num_frames=30))
    video = Video(tmp_path / f"a{suffix}")
    found = numbers(video, np.arange(30) / 10)
    lost = [index for index, number in enumerate(found) if number is None]
    assert 1 <= len(lost) <= 3
    # A decoder may show the frame before in place of one that is damaged.
    wrong = [index for index, number in enumerate(found) if number not in (None, index)]
    assert len(wrong) <= 1
    assert set(wrong) <= {lost[0] - 1}
    with pytest.raises(ValueError, match="it is damaged there, or frames were dropped"):
        video.image_at(lost[0] / 10, 0.05)


@pytest.mark.parametrize("suffix", [".avi", ".mkv"])
def test_a_video_that_is_cut_short_ends_where_it_ends(tmp_path, suffix):
    cut(write_video(tmp_path / f"a{suffix}", num_frames=30))
    header = Video(tmp_path / f"a{suffix}").header
    assert header.is_cut_short
    assert header.said_last_s == pytest.approx(2.9)
    assert 1 < header.last_s < 2


def test_uneven_frames_are_taken_by_their_time_stamps(tmp_path, caplog):
    path = write_video(tmp_path / "a.mp4")
    delay_frames(path, first=8)
    video = Video(path)
    rate = video.header.frames_per_second
    caplog.clear()
    found = numbers(video, [0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.8], within_s=0.5 / rate)
    assert found == [6, 7, None, None, 8, 9, 16]
    (told,) = [record.getMessage() for record in caplog.records]
    assert "its frames are not evenly spaced" in told
    assert "0.300 s after the one before, at 1.000 s" in told


def test_frames_are_turned_where_the_calibrated_size_says_so(tmp_path):
    path = write_video(tmp_path / "a.mp4")
    note_turn(path)
    video = Video(path)
    assert video.header.turn == 90
    stored, shown = video.image_at(0.0, 0.05, (64, 48)), video.image_at(0.0, 0.05, (48, 64))
    np.testing.assert_array_equal(shown, np.rot90(stored, -1))
    assert video.image_at(0.0, 0.05).shape == shown.shape
    with pytest.raises(
        ValueError, match=r"is 64 x 48 \(to be turned by 90 degrees\); the rig was calibrated"
    ):
        video.image_at(0.0, 0.05, (100, 48))
    square = write_video(tmp_path / "b.mp4", size_wh=(48, 48))
    note_turn(square)
    with pytest.raises(ValueError, match="fits the rig turned and not turned"):
        Video(square).image_at(0.0, 0.05, (48, 48))


def test_what_is_no_video_is_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="no video at"):
        Video(tmp_path / "none.mp4")
    for name, data in (("text.mp4", b"hello" * 100), ("empty.mp4", b"")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match=rf"{name} cannot be read as a video \({len(data)} bytes\)"):
            Video(tmp_path / name)
    cut(write_video(tmp_path / "cut.mp4"))
    with pytest.raises(ValueError, match="cut short before its index was written"):
        Video(tmp_path / "cut.mp4")
    with pytest.raises(ValueError, match=r"none\.avi (cannot be read|has no frame|says that)"):
        Video(write_video(tmp_path / "none.avi", num_frames=0))
