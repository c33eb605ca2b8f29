"""Key points of videos: a search that is stopped goes on, and what is wrong costs no more than it must."""

import logging

import cv2
import numpy as np
import pytest

from poem_jax.calibration.rig_json import read_rig, write_rig
from poem_jax.capture import detect
from poem_jax.capture.boxes_file import read_boxes
from poem_jax.capture.detections import Detections, SearchFile
from poem_jax.capture.take import read_keypoint_take, read_take
from poem_jax.capture.timing import Timing
from poem_jax.cli import main
from poem_jax.data.lens import project_raw
from poem_jax.detection import DetectedHand
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from tests.videos import cut, damage, number_of, picture, write_video

FRAMES = 14
SIZE_WH = (240, 180)


class Seen:
    """A detector that sees a right hand in every image, and tells by its score which frame it saw."""

    def __init__(self, rig, stop_at=None):
        joints = np.asarray(
            hand_mesh(default_hand("right"), np.zeros((16, 3)), np.zeros(10), np.zeros(3)).joints
        )
        self._places = [project_raw(rig, view, joints - joints[9])[0] for view in range(rig.num_views)]
        self.stop_at, self.images = stop_at, 0

    def __call__(self, views, images):
        numbers = [number_of(image) for image in images]
        if self.stop_at is not None and min(numbers) >= self.stop_at:
            raise KeyboardInterrupt
        self.images += len(images)
        return [
            [DetectedHand(self._places[view], "right", 0.8, 0.5 + number / 100)]
            for view, number in zip(views, numbers, strict=True)
        ]


@pytest.fixture
def folder(tmp_path, rig):
    """Three videos and their calibration."""
    place = tmp_path / "take"
    place.mkdir()
    write_rig(place / "rig.json", rig)
    for seed, camera in enumerate(rig.names):
        write_video(place / f"{camera}.avi", FRAMES, size_wh=SIZE_WH, seed=seed)
    return place


@pytest.fixture
def search(folder, tmp_path, rig, monkeypatch):
    """Run `poem detect` over the videos: `search(*options, stop_at=None)` gives exit code and detector."""

    def run(*options, stop_at=None, name="found"):
        seen = Seen(rig, stop_at)
        monkeypatch.setattr(detect, "_our_detector", lambda *_: seen)
        return main(["detect", str(folder), "--out", str(tmp_path / f"{name}.npz"), *options]), seen

    return run


def numbers(path):
    """Which frame of each view was seen at every moment (frame, view); NaN = none."""
    confidence = np.nan_to_num(read_boxes(path).confidence[:, 0]).max(-1)
    return np.where(confidence == 0, np.nan, np.round(100 * (confidence - 0.5)))


def test_hands_are_found_in_videos(search, tmp_path):
    assert search()[0] == 0
    hands = read_boxes(tmp_path / "found.npz")
    np.testing.assert_array_equal(numbers(tmp_path / "found.npz"), np.tile(np.arange(FRAMES)[:, None], 3))
    np.testing.assert_allclose(hands.time_s, np.arange(FRAMES) / 10)
    assert hands.frames[:2] == ("0000", "0001")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["found.npz", "found.search", "take"]


def test_offsets_and_part_of_a_take(search, tmp_path):
    assert search("--offsets", "front=0.3", "--start", "0.5", "--end", "9f", "--every", "2")[0] == 0
    np.testing.assert_array_equal(numbers(tmp_path / "found.npz"), [[8, 5, 8], [10, 7, 10]])
    np.testing.assert_allclose(read_boxes(tmp_path / "found.npz").time_s, [0.5, 0.7])


def test_images_beside_key_points_are_those_in_which_they_were_found(search, folder, tmp_path, caplog):
    found = tmp_path / "found.npz"
    search("--offsets", "front=0.3")
    np.testing.assert_allclose(read_boxes(found).offsets_s, [0, 0.3, 0])
    frames = list(read_keypoint_take(found, images=folder).frames)
    assert "images are taken under the offsets" in caplog.text
    shown = [[number_of(image.read()) for image in frame.image_files] for frame in frames]
    np.testing.assert_array_equal(shown, numbers(found))
    caplog.clear()
    same = read_take(folder, boxes=found, timing=Timing({"front": 0.3}))
    assert [frame.name for frame in same.frames] == [frame.name for frame in frames]
    assert "images are taken" not in caplog.text
    with pytest.raises(ValueError, match=r"found under other offsets \(front=0.3, not 0.1 s\)"):
        read_take(folder, boxes=found, timing=Timing({"front": 0.1}))


def test_a_rig_is_checked_by_hands_that_it_did_not_put_together(search, folder, rig, tmp_path, capsys):
    """With the wrong rig no two views meet, and a camera that was moved would be left out."""
    search()
    check = ["calibration", "check", str(folder / "rig.json"), "--videos", str(folder)]
    assert main([*check, "--out", str(tmp_path / "good")]) == 0
    T = rig.T_cam_from_world.copy()
    T[1, 0, 3] += 0.1
    for wrong, told in (
        (invert_rigid(rig.T_cam_from_world), "inverted extrinsics"),
        (T, "camera moved"),
    ):
        write_rig(folder / "rig.json", rig._replace(T_cam_from_world=wrong))
        capsys.readouterr()
        assert main([*check, "--out", str(tmp_path / told)]) == 1
        assert told in capsys.readouterr().out


def test_a_detector_that_mistakes_sides_is_not_the_rigs_fault(search, folder, tmp_path, monkeypatch):
    search()

    class Mistaken(Seen):
        def __call__(self, views, images):
            found = super().__call__(views, images)
            return [
                [hand._replace(side="left" if view == 1 else hand.side) for hand in hands]
                for view, hands in zip(views, found, strict=True)
            ]

    rig = read_rig(folder / "rig.json")
    mistaken = Mistaken(rig)
    monkeypatch.setattr(detect, "_our_detector", lambda *_: mistaken)
    check = ["calibration", "check", str(folder / "rig.json"), "--videos", str(folder)]
    assert main([*check, "--out", str(tmp_path / "good")]) == 0
    assert mistaken.images == 3 * FRAMES, "the images are searched once"


def test_a_search_that_is_stopped_goes_on(search, tmp_path, capsys, caplog):
    assert search(name="whole")[0] == 0
    code, first = search(stop_at=9)
    assert code == 130
    assert "the same command goes on from there" in capsys.readouterr().err
    part = read_boxes(tmp_path / "found.part.npz")
    assert len(part.frames) == 9
    code, second = search()
    assert code == 0
    assert f"9 of {FRAMES} frames were searched before" in caplog.text
    assert first.images + second.images == 3 * FRAMES
    whole, found = (np.load(tmp_path / f"{name}.npz") for name in ("whole", "found"))
    assert set(whole) == set(found)
    for name in whole:
        np.testing.assert_array_equal(whole[name], found[name])
    assert not (tmp_path / "found.part.npz").exists()


def test_a_search_that_was_killed_goes_on(search, tmp_path):
    """The file ends anywhere: within a frame, or within its first line."""
    kept = tmp_path / "found.search"
    search(stop_at=9)
    data = kept.read_bytes()
    for end, done in ((len(data) - 100, 8), (20, 0)):
        kept.write_bytes(data[:end])
        code, seen = search()
        assert code == 0
        assert seen.images == 3 * (FRAMES - done)
        np.testing.assert_array_equal(numbers(tmp_path / "found.npz"), np.tile(np.arange(FRAMES)[:, None], 3))


def test_another_search_begins_anew(search, folder, rig, capsys):
    search(stop_at=9)
    _, seen = search("--max-hands", "1", stop_at=12)
    assert seen.images == 3 * 12
    assert "is of other images or options: the search begins anew" in capsys.readouterr().err
    write_video(folder / f"{rig.names[0]}.avi", FRAMES, size_wh=SIZE_WH, seed=9)
    _, seen = search("--max-hands", "1")
    assert seen.images == 3 * FRAMES
    assert "is of other images or options: the search begins anew" in capsys.readouterr().err


def test_a_longer_search_goes_on_from_a_shorter_one(search):
    search("--end", "1", stop_at=5)
    assert search()[1].images == 3 * (FRAMES - 5)


def test_a_longer_search_goes_on_in_images_too(search, folder, rig):
    (folder / "sync.json").write_text('{"frames_per_second": 10}')
    for seed, camera in enumerate(rig.names):
        (folder / f"{camera}.avi").unlink()
        (folder / camera).mkdir()
        for index in range(FRAMES):
            file = folder / camera / f"{index:04d}.png"
            cv2.imwrite(str(file), picture(index, size_wh=SIZE_WH, seed=seed))
    assert search("--end", "5f")[0] == 0
    code, seen = search()
    assert (code, seen.images) == (0, 3 * (FRAMES - 5))
    code, seen = search("--end", "0.7")
    assert (code, seen.images) == (0, 0)


def test_another_search_is_kept_and_comes_back(search, tmp_path, caplog):
    kept, old = tmp_path / "found.search", tmp_path / "found.search.old"
    search(stop_at=9)
    first = kept.read_bytes()
    search("--max-hands", "1", stop_at=5)
    second = kept.read_bytes()
    assert old.read_bytes() == first
    assert f"{kept} was of another search, and is kept as {old}" in caplog.text
    code, seen = search()
    assert (code, seen.images) == (0, 3 * (FRAMES - 9))
    assert old.read_bytes() == second
    whole = kept.read_bytes()
    assert whole.startswith(first)
    # A search that found nothing yet takes no room from one that did.
    kept.write_bytes(b"cut short")
    old.write_bytes(whole)
    search("--max-hands", "1", stop_at=5)
    assert old.read_bytes() == whole
    assert sorted(tmp_path.glob("found.search*")) == [kept, old]


def test_what_was_found_is_not_searched_for_again(folder, tmp_path, rig, monkeypatch, caplog):
    """`reconstruct` that is stopped later begins with the key points that it has."""
    seen = Seen(rig)
    monkeypatch.setattr(detect, "_our_detector", lambda *_: seen)

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("poem_jax.capture.pipeline.fit", stop)
    command = ["fit", str(folder), "--out", str(tmp_path / "out")]
    assert main(command) == 130
    assert main(command) == 130
    assert seen.images == 3 * FRAMES
    assert f"{FRAMES} of {FRAMES} frames were searched before" in caplog.text
    before = read_boxes(tmp_path / "out" / "keypoints.npz")
    write_rig(folder / "rig.json", rig._replace(K=rig.K * [[1.01], [1.01], [1]]))
    assert main(command) == 130
    assert seen.images == 3 * FRAMES, "a better calibration needs no new search"
    np.testing.assert_array_equal(read_boxes(tmp_path / "out" / "keypoints.npz").frames, before.frames)


def test_a_damaged_frame_costs_its_view(search, folder, tmp_path, rig, caplog):
    for seed, camera in enumerate(rig.names):
        (folder / f"{camera}.avi").unlink()
        write_video(folder / f"{camera}.mp4", 24, size_wh=SIZE_WH, seed=seed)
    damage(folder / "front.mp4", size=6000)
    with caplog.at_level(logging.WARNING):
        assert search()[0] == 0
    found = numbers(tmp_path / "found.npz")
    np.testing.assert_array_equal(found[:, [0, 2]], np.tile(np.arange(24)[:, None], 2))
    lost = np.isnan(found[:, 1])
    assert 1 <= lost.sum() <= 10
    assert (found[~lost, 1] == np.flatnonzero(~lost)).mean() > 0.9
    told = [record.getMessage() for record in caplog.records if "an image is left out" in record.getMessage()]
    assert len(told) == 1
    assert "it is damaged there" in told[0]


def test_a_video_that_is_cut_short_ends_the_take(search, folder, tmp_path, rig, caplog):
    cut(folder / f"{rig.names[1]}.avi")
    assert search()[0] == 0
    assert "front.avi is cut short" in caplog.text
    assert 5 < len(numbers(tmp_path / "found.npz")) < 12


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("extra.mp4", "extra.mp4 is of no camera of the rig"),
        ("front.mp4", "are both of camera 'front'"),
    ],
)
def test_videos_that_do_not_fit_the_rig_are_refused(search, folder, capsys, name, message):
    write_video(folder / name)
    assert search()[0] == 2
    assert message in capsys.readouterr().err


def test_what_is_no_video_is_refused(search, folder, capsys):
    (folder / "front.avi").write_bytes(b"no video")
    assert search()[0] == 2
    error = capsys.readouterr().err
    assert "front.avi cannot be read as a video (8 bytes)" in error
    assert error.count("poem:") == 1


def test_videos_of_another_size_are_refused(search, folder, rig, capsys):
    for camera in rig.names:
        write_video(folder / f"{camera}.avi", FRAMES)
    assert search()[0] == 2
    assert "is 64 x 48; the rig was calibrated at 240 x 180" in capsys.readouterr().err


def test_no_hand_at_all(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(detect, "_our_detector", lambda *_: lambda views, images: [[] for _ in views])
    assert main(["detect", str(folder), "--out", str(tmp_path / "found.npz")]) == 2
    assert f"no hand was found in any image of {FRAMES} frames" in capsys.readouterr().err
    assert not (tmp_path / "found.npz").exists()


def test_where_nothing_can_be_written_nothing_is_searched(search, folder, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    code = main(["detect", str(folder), "--out", str(tmp_path / "file" / "found.npz")])
    assert code == 2
    assert "cannot write the file" in capsys.readouterr().err


def test_a_full_disk_leaves_what_was_found(search, tmp_path, monkeypatch, capsys):
    add = SearchFile.add

    def add_until_full(self, frame, count=[0]):  # noqa: B006
        count[0] += 1
        if count[0] == 8:
            raise OSError(28, "No space left on device")
        add(self, frame)

    with monkeypatch.context() as patched:
        patched.setattr(SearchFile, "add", add_until_full)
        assert search()[0] == 2
    assert "the disk is full: make room" in capsys.readouterr().err
    assert search()[1].images == 3 * (FRAMES - 7)


def test_detections_come_back_as_they_were(tmp_path):
    rng = np.random.default_rng(0)

    def hand():
        side = ("left", "right")[rng.integers(2)]
        return DetectedHand(rng.uniform(0, 900, (21, 2)), side, float(rng.uniform()), float(rng.uniform()))

    frames = [[[hand() for _ in range(rng.integers(4))], None, [hand()]] for _ in range(600)]
    file = SearchFile(tmp_path / "a.search", "x")
    kept = file.take_up(3)
    for frame in frames:
        file.add(kept.append(frame))
    file.close()
    again = SearchFile(tmp_path / "a.search", "x")
    read = again.take_up(3)
    again.close()
    for found in (kept, read, kept[:600]):
        assert isinstance(found, Detections)
        assert len(found) == 600
        np.testing.assert_array_equal(found.looked_at[0], [True, False, True])
        for expected, views in zip(frames, found, strict=True):
            assert [len(hands) for hands in views] == [len(hands or ()) for hands in expected]
            for a, b in zip(expected[0], views[0], strict=True):
                np.testing.assert_allclose(a.keypoints_px, b.keypoints_px, rtol=1e-6)
                assert (a.side, a.score) == (b.side, pytest.approx(b.score))
    assert len(kept[:5]) == 5
    assert SearchFile(tmp_path / "a.search", "y").holds_another_search()
