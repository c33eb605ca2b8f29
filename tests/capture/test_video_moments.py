"""Which frames of which cameras belong together: by time, by name, and what is said of what does not fit."""

import json
import math

import cv2
import numpy as np
import pytest

from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture.boxes_file import HandBoxes, write_boxes
from poem_jax.capture.moments import find_moments
from poem_jax.capture.read import read_images
from poem_jax.capture.take import read_keypoint_take, read_take
from poem_jax.capture.timing import Timing, parse_timing
from tests.videos import cut, damage, number_of, picture, write_video

CAMERAS = ("left_cam", "front", "cam 3")


@pytest.fixture
def rig(rig):
    """As of the suite, its images shrunk to 64 x 48."""
    assert rig.names == CAMERAS
    return rig._replace(size_wh=np.tile([64, 48], (3, 1)), K=rig.K * [[64 / 240], [48 / 180], [1]])


@pytest.fixture
def videos(tmp_path):
    """Write a video for each camera: `videos(left_cam={"rate": 20})` changes one, `front=None` omits it."""

    def write(**changes):
        for seed, camera in enumerate(CAMERAS):
            options = changes.get(camera.replace(" ", "_"), {})
            if options is not None:
                write_video(tmp_path / f"{camera}.avi", seed=seed, **options)
        return tmp_path

    return write


def numbers(moments):
    """The number of every camera's frame at every moment, None where there is none."""
    table = []
    for frame in moments.frames:
        row = []
        for source in frame.images:
            try:
                row.append(None if source is None else number_of(source.read((64, 48))))
            except ValueError:
                row.append(None)
        table.append(row)
    return table


def test_videos_of_one_rate_go_together(videos, rig, caplog):
    moments = find_moments(videos(), rig)
    assert numbers(moments) == [[i] * 3 for i in range(20)]
    assert [frame.name for frame in moments.frames] == [f"{i:04d}" for i in range(20)]
    np.testing.assert_allclose([frame.time_s for frame in moments.frames], np.arange(20) / 10)
    assert (moments.frames_per_second, moments.is_video, moments.follow_closely) == (10, True, True)
    assert caplog.text == ""


@pytest.mark.parametrize("offset_s", [0.3, -0.3, 0.34])
def test_what_began_later_shows_later_moments(videos, rig, caplog, offset_s):
    folder = videos()
    moments = find_moments(folder, rig, Timing({"front": offset_s}))
    shift = round(10 * offset_s)
    first = max(shift, 0) if offset_s != 0.34 else math.ceil(3.4)
    expected = [[i, i - shift, i] for i in range(first, 20 + min(shift, 0))]
    assert numbers(moments) == expected
    assert moments.frames[0].time_s == 0
    assert "the videos do not cover the same time" in caplog.text
    (folder / "sync.json").write_text(json.dumps({"offsets_s": {"front": offset_s}}))
    assert numbers(find_moments(folder, rig)) == expected
    assert numbers(find_moments(folder, rig, Timing({"front": 0.0})))[0] == [0, 0, 0]


def test_the_slowest_camera_gives_the_moments(videos, rig, caplog):
    moments = find_moments(videos(left_cam={"rate": 30, "num_frames": 30}, front={"num_frames": 10}), rig)
    assert numbers(moments) == [[3 * i, i, i] for i in range(10)]
    assert "different rates, 30 (left_cam), 10 (front), 10 (cam 3) frames/s" in caplog.text
    assert "frames up to 17 ms away" in caplog.text
    assert "0.00 to 2.00 s (cam 3); what all have is used, 1.00 s" in caplog.text


def test_true_rates_replace_those_of_the_files(videos, rig):
    folder = videos(left_cam={"rate": 20})
    (folder / "sync.json").write_text(json.dumps({"frames_per_second": 10}))
    assert numbers(find_moments(folder, rig)) == [[i] * 3 for i in range(20)]


def test_rates_that_cannot_be_of_one_take_are_refused(videos, rig):
    with pytest.raises(ValueError, match=r"at most 10 times apart; got 120 \(left_cam\), 10 \(front\)"):
        find_moments(videos(left_cam={"rate": 120}), rig)


def test_videos_without_a_common_moment_are_refused(videos, rig):
    with pytest.raises(
        ValueError, match=r"no moment in common: .*5\.00 to 7\.00 s \(front\).*check the offs"
    ):
        find_moments(videos(), rig, Timing({"front": 5.0}))


def test_a_video_that_is_cut_short_is_told(videos, rig, caplog):
    folder = videos()
    cut(folder / "front.avi")
    moments = find_moments(folder, rig)
    assert 8 < len(moments.frames) < 15
    assert "front.avi is cut short: it ends at" in caplog.text
    assert "and says that it lasts until 1.90 s" in caplog.text


def test_an_avi_that_lacks_frames_is_told(videos, rig, caplog):
    """Its frames are counted, and what follows the gap gets the time of an earlier one."""
    folder = videos(front={"num_frames": 30}, left_cam={"num_frames": 30}, cam_3={"num_frames": 30})
    damage(folder / "front.avi", size=2000)
    find_moments(folder, rig)
    assert "front.avi has 2 frames fewer than it says" in caplog.text


def test_part_of_a_take(videos, rig):
    folder = videos()
    by_frames = find_moments(folder, rig, parse_timing(None, "5f", "12f", 3))
    by_seconds = find_moments(folder, rig, parse_timing(None, "0.5", "1.2s", 3))
    for moments in (by_frames, by_seconds):
        assert numbers(moments) == [[i] * 3 for i in (5, 8, 11)]
        assert [frame.name for frame in moments.frames] == ["0005", "0008", "0011"]
        np.testing.assert_allclose([frame.time_s for frame in moments.frames], [0.5, 0.8, 1.1])
        assert moments.frames_per_second == pytest.approx(10 / 3)
        assert not moments.follow_closely
    assert len(find_moments(folder, rig, parse_timing(None, None, "99", 1)).frames) == 20
    with pytest.raises(
        ValueError, match=r"take, which has 20 frames, 2\.00 s, and before --end; they are fra"
    ):
        find_moments(folder, rig, parse_timing(None, "3", None, 1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("front:1", None, None, 1), "--offsets must be like cam_1=0.35"),
        (("front=nan", None, None, 1), "--offsets must be like"),
        (("a=1,a=2", None, None, 1), "gives camera 'a' twice"),
        ((None, "soon", None, 1), r"--start must be seconds \(2.5\) or a frame \(75f\)"),
        ((None, "5f", "5f", 1), "--end must be behind --start; got 5f and 5f"),
        ((None, None, None, 0), "--every must be 1 or more; got 0"),
    ],
)
def test_options_that_cannot_be_read(options, message):
    with pytest.raises(ValueError, match=message):
        parse_timing(*options)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1], "must hold an object with offsets_s and frames_per_second; got list"),
        ({"offset": {}}, "must hold an object with .*; got offset"),
        ({"offsets_s": {"cam 9": 1}}, "there is no camera 'cam 9' in the rig; it has left_cam, front, cam 3"),
        ({"offsets_s": {"front": "1"}}, "`offsets_s` of front must be a number from .*; got '1'"),
        ({"offsets_s": 1}, "`offsets_s` must be seconds by camera; got 1"),
        ({"frames_per_second": 0}, "`frames_per_second` of left_cam must be a number from 0.001 to 10000"),
    ],
)
def test_a_wrong_file_of_offsets(videos, rig, content, message):
    (videos() / "sync.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        find_moments(videos(), rig)


def test_a_camera_without_a_video_sees_nothing(videos, rig, caplog):
    folder = videos(front=None)
    assert numbers(find_moments(folder, rig))[4] == [4, None, 4]
    assert "has no videos of front: these cameras see nothing" in caplog.text
    (folder / "cam 3.avi").unlink()
    with pytest.raises(ValueError, match="has videos of left_cam alone, none of front, cam 3"):
        find_moments(folder, rig)


def test_a_video_of_no_camera_is_refused(videos, rig):
    folder = videos()
    write_video(folder / "backdoor.mp4")
    with pytest.raises(
        ValueError,
        match=r"backdoor\.mp4 is of no camera of the rig; the videos are backdoor\.mp4, cam 3\.avi",
    ):
        find_moments(folder, rig)


def test_videos_beside_frames_are_refused(videos, rig):
    folder = videos()
    (folder / "frames").mkdir()
    with pytest.raises(ValueError, match=r"holds videos \(cam 3\.avi, \.\.\.\) and images \(frames/\)"):
        find_moments(folder, rig)


def test_a_take_tells_its_times(videos, rig, tmp_path):
    boxes = np.tile([10.0, 10.0, 40.0, 40.0], (20, 1, 3, 1))
    names = tuple(f"{index:04d}" for index in range(20))
    write_boxes(tmp_path / "boxes.npz", HandBoxes(boxes, ("right",), names))
    write_rig(tmp_path / "rig.json", rig)
    take = read_take(videos(), timing=parse_timing(None, "0.5", None, 2))
    assert (take.frames_per_second, take.num_frames) == (5, 8)
    frames = list(read_images(take.frames, take.rig))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(5, 20, 2) / 10)
    assert [[number_of(image) for image in frame.images] for frame in frames] == [
        [i] * 3 for i in range(5, 20, 2)
    ]


def test_key_points_of_part_of_a_take_find_their_frames(videos, rig, tmp_path):
    write_rig(tmp_path / "rig.json", rig)
    keypoints = np.random.default_rng(0).uniform(5, 40, (4, 1, 3, 21, 2))
    boxes = np.concatenate([keypoints.min(-2), keypoints.max(-2)], -1)
    names = ("0003", "0006", "0009", "0030")
    hands = HandBoxes(boxes, ("right",), names, keypoints, time_s=np.array([0.3, 0.6, 0.9, 3.0]))
    file = write_boxes(tmp_path / "found.npz", hands)
    take = read_keypoint_take(file, images=videos())
    frames = list(read_images(take.frames, take.rig, needed=False))
    assert [frame.name for frame in frames] == list(names)
    assert [frame.time_s for frame in frames] == [0.3, 0.6, 0.9, 3.0]
    found = [[None if image is None else number_of(image) for image in frame.images] for frame in frames]
    assert found == [[3] * 3, [6] * 3, [9] * 3, [None] * 3]
    assert take.frames_per_second == pytest.approx(10 / 3)
    alone = read_keypoint_take(file)
    assert alone.frames_per_second == pytest.approx(10 / 3)


class TestFolders:
    """A folder of images for each camera."""

    @pytest.fixture
    def folders(self, tmp_path):
        for seed, camera in enumerate(CAMERAS):
            (tmp_path / camera).mkdir()
            for index in range(1, 9):
                cv2.imwrite(str(tmp_path / camera / f"{index:04d}.png"), picture(index, seed=seed))
        return tmp_path

    @staticmethod
    def numbers(moments):
        def of(path):
            return None if path is None else number_of(cv2.imread(str(path)))

        return [[of(path) for path in frame.images] for frame in moments.frames]

    def test_images_of_one_number_go_together(self, folders, rig):
        (folders / "front" / "0003.png").unlink()
        moments = find_moments(folders, rig)
        expected = [[i, i if i != 3 else None, i] for i in range(1, 9)]
        assert self.numbers(moments) == expected
        assert [frame.name for frame in moments.frames][:3] == ["0001", "0002", "0003"]
        assert (moments.frames_per_second, moments.is_video) == (None, False)
        assert moments.frames[0].time_s is None
        with pytest.raises(ValueError, match=r"--start 0\.5 is in seconds, and these images have no times"):
            find_moments(folders, rig, parse_timing(None, "0.5", None, 1))

    def test_names_may_say_more_than_the_number(self, folders, rig):
        for path in (folders / "front").iterdir():
            path.rename(path.with_name(f"front_2024_{path.name}"))
        assert self.numbers(find_moments(folders, rig)) == [[i] * 3 for i in range(1, 9)]

    def test_offsets_need_a_rate(self, folders, rig):
        with pytest.raises(ValueError, match=r'need their rate: put \{"frames_per_second": 30\} into .*sync'):
            find_moments(folders, rig, Timing({"front": 0.2}))
        (folders / "sync.json").write_text('{"frames_per_second": 10}')
        moments = find_moments(folders, rig, Timing({"front": 0.2}))
        assert self.numbers(moments)[2:8] == [[i, i - 2, i] for i in range(3, 9)]
        np.testing.assert_allclose([frame.time_s for frame in moments.frames], np.arange(10) / 10)

    def test_what_is_wrong_is_told(self, folders, rig, caplog):
        (folders / "front" / "last.png").write_bytes(b"")
        with pytest.raises(ValueError, match=r"last\.png has no number"):
            find_moments(folders, rig)
        (folders / "front" / "last.png").rename(folders / "front" / "4.png")
        with pytest.raises(ValueError, match=r"0004\.png and 4\.png in .*front have one number"):
            find_moments(folders, rig)
        (folders / "front" / "4.png").rename(folders / "front" / "9.png")
        find_moments(folders, rig)
        assert "different numbers of images, 8 (cam 3), 9 (front), 8 (left_cam)" in caplog.text
