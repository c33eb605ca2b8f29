"""Key points from the images of a capture: their places, missing images, interruption, and the commands."""

import cv2
import numpy as np
import pytest

from poem_jax.capture.boxes_file import HandBoxes, read_boxes
from poem_jax.capture.detect import detect_hands
from poem_jax.cli import main
from poem_jax.data.capture_folder import find_frames, hand_names
from poem_jax.data.lens import project_raw
from poem_jax.detection import DetectedHand
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand


@pytest.fixture
def hand_world():
    """Joints of a right hand in the middle of the rig."""
    joints = np.asarray(hand_mesh(default_hand("right"), np.zeros((16, 3)), np.zeros(10), np.zeros(3)).joints)
    return joints - joints[9]


@pytest.fixture
def capture(tmp_path, rig):
    """Three cameras, two frames of one grey each; one image is missing, one is damaged."""
    for frame, camera, value in ((0, 0, 10), (0, 1, 11), (1, 0, 20), (1, 1, 21), (1, 2, 22)):
        folder = tmp_path / "frames" / str(frame)
        folder.mkdir(parents=True, exist_ok=True)
        width, height = rig.size_wh[camera]
        image = np.full((height, width, 3), value, np.uint8)
        cv2.imwrite(str(folder / f"{rig.names[camera]}.png"), image)
    (tmp_path / "frames" / "1" / f"{rig.names[2]}.png").write_bytes(b"no image")
    return find_frames(tmp_path, rig.names)


@pytest.fixture
def seen(rig, hand_world):
    """A detector that sees the hand in every image, as a left one in the second camera."""

    def detector(views, images):
        sides = ("right", "left", "right")
        return [
            [DetectedHand(project_raw(rig, view, hand_world)[0], sides[view], 0.8, 0.9)] for view in views
        ]

    return detector


@pytest.fixture
def hand_boxes(rig):
    """What a search found in one frame."""
    boxes = np.tile([10.0, 10.0, 90.0, 90.0], (1, 1, rig.num_views, 1))
    return HandBoxes(boxes, ("right",), ("0",), cameras=rig.names)


def test_hands_go_to_their_frame_and_view(capture, rig, seen, hand_world, caplog):
    hands = detect_hands(capture, rig, detector=seen, progress=False)
    assert hands.hand_side == ("right",)
    assert hands.frames == ("0", "1")
    assert hands.cameras == rig.names
    found = np.isfinite(hands.boxes_px).all(-1)
    np.testing.assert_array_equal(found, [[[True, True, False]], [[True, True, False]]])
    np.testing.assert_allclose(hands.keypoints_px[1, 0, 0], project_raw(rig, 0, hand_world)[0])
    np.testing.assert_allclose(hands.confidence[1, 0, :2], 0.9)
    assert np.isnan(hands.confidence[:, 0, 2]).all()
    assert f"frame 0: an image is left out: there is none of camera '{rig.names[2]}'" in caplog.text
    assert f"camera '{rig.names[2]}': 2 of 2 images are left out in all" in caplog.text


def test_a_camera_that_shows_no_hand_is_named(capture, rig, seen, caplog):
    def blind(views, images):
        return [[] if view == 1 else hands for view, hands in zip(views, seen(views, images), strict=True)]

    hands = detect_hands(capture, rig, detector=blind, progress=False)
    assert np.isfinite(hands.boxes_px).all(-1).sum() == 2
    assert f"camera '{rig.names[1]}' shows no hand in any image" in caplog.text
    assert f"only camera {rig.names[0]} sees hands" in caplog.text


def test_images_none_of_which_can_be_read_name_the_first(capture, rig):
    small = rig._replace(size_wh=rig.size_wh // 2)
    with pytest.raises(ValueError, match=r"left_cam\.png is 240 x 180; the rig was calibrated at 120 x 90"):
        detect_hands(capture, small, progress=False)


def test_guesses_beyond_the_border_are_unseen(capture, rig, hand_world):
    aside = hand_world + np.array([0, 0, 0.26])
    uv = [project_raw(rig, view, aside)[0] for view in range(3)]

    def detector(views, images):
        return [[DetectedHand(uv[view], "right", 0.9, 0.9)] for view in views]

    hands = detect_hands(capture, rig, detector=detector, progress=False)
    inside = ((uv[0] >= 0) & (uv[0] <= rig.size_wh[0])).all(-1)
    assert 5 < inside.sum() < 21
    np.testing.assert_array_equal(np.isfinite(hands.keypoints_px[0, 0, 0]).all(-1), inside)
    assert np.isfinite(hands.keypoints_px[0, 0, 1]).all()


def test_a_search_that_is_stopped_keeps_the_frames_that_are_done(capture, rig, seen):
    kept = []

    def stopped_at_the_second(views, images):
        if images[0][0, 0, 0] >= 20:
            raise KeyboardInterrupt
        return seen(views, images)

    with pytest.raises(KeyboardInterrupt):
        detect_hands(capture, rig, detector=stopped_at_the_second, when_stopped=kept.append, progress=False)
    (hands,) = kept
    assert hands.frames == ("0",)
    assert np.isfinite(hands.boxes_px).all(-1).sum() == 2


def test_a_search_that_is_stopped_too_early_writes_nothing(capture, rig, seen, caplog):
    def disagreeing(views, images):
        if images[0][0, 0, 0] >= 20:
            raise KeyboardInterrupt
        return [
            [hand._replace(keypoints_px=hand.keypoints_px + 40 * view * np.array([1, -1]))]
            for view, (hand,) in zip(views, seen(views, images), strict=True)
        ]

    kept = []
    with pytest.raises(KeyboardInterrupt):
        detect_hands(capture, rig, detector=disagreeing, when_stopped=kept.append, progress=False)
    assert kept == []
    assert "no key points are written of the frames that were searched" in caplog.text


def test_part_of_a_search_has_a_name_of_its_own(make_capture, monkeypatch, capsys, hand_boxes):
    def stopped(*_, when_stopped, **__):
        when_stopped(hand_boxes)
        raise KeyboardInterrupt

    folder = make_capture().folder
    out, part = folder / "found.npz", folder / "found.part.npz"
    command = ["detect", str(folder), "--out", str(out)]
    out.write_bytes(b"whole")
    with monkeypatch.context() as patched:
        patched.setattr("poem_jax.capture.detect.detect_hands", stopped)
        assert main(command) == 130
    assert f"what was done so far is in {part}" in capsys.readouterr().err
    assert read_boxes(part).frames == hand_boxes.frames
    assert out.read_bytes() == b"whole"
    monkeypatch.setattr("poem_jax.capture.detect.detect_hands", lambda *_, **__: hand_boxes)
    assert main(command) == 0
    assert read_boxes(out).frames == hand_boxes.frames
    assert not part.exists()


def test_no_hand_at_all_is_an_error(capture, rig):
    with pytest.raises(ValueError, match="no hand was found in any image of 2 frames"):
        detect_hands(capture, rig, detector=lambda views, images: [[] for _ in views], progress=False)


def test_images_without_a_hand_are_searched_by_our_own_networks(capture, rig):
    with pytest.raises(ValueError, match="no hand was found"):
        detect_hands(capture, rig, progress=False)
    with pytest.raises(ValueError, match="no hand was found"):
        detect_hands(capture, rig, video=True, progress=False)


@pytest.mark.parametrize("name", ["rig.json", "front.png"])
def test_key_points_do_not_replace_what_they_are_found_in(make_capture, capsys, name):
    folder = make_capture().folder
    before = (folder / name).read_bytes()
    assert main(["detect", str(folder), "--out", str(folder / name)]) == 2
    assert f"{name} would be replaced by a result, and is read; give another --out" in capsys.readouterr().err
    assert (folder / name).read_bytes() == before


@pytest.mark.parametrize("command", ["detect", "fit", "reconstruct"])
def test_a_number_of_hands_below_one_is_refused(make_capture, tmp_path, capsys, command):
    folder = make_capture().folder
    (folder / "boxes.npz").unlink(missing_ok=True)
    assert main([command, str(folder), "--out", str(tmp_path / "out"), "--max-hands", "0"]) == 2
    assert "--max-hands must be 1 or more; got 0" in capsys.readouterr().err


def test_key_points_beside_the_images_are_taken(make_capture, tmp_path, capsys):
    folder = make_capture(keypoints=True).folder
    (folder / "boxes.npz").rename(folder / "keypoints.npz")
    assert main(["fit", str(folder), "--out", str(tmp_path / "out")]) in (0, 2)
    assert f"hands are where {folder / 'keypoints.npz'} says" in capsys.readouterr().err


def test_a_folder_of_images_brings_its_own(make_capture, tmp_path, capsys):
    folder = make_capture().folder
    assert main(["fit", str(folder), "--images", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "--images goes with a file of key points" in capsys.readouterr().err


@pytest.mark.parity
@pytest.mark.parametrize("command", [["fit"], ["reconstruct"], ["reconstruct", "--engine", "fit"]])
def test_images_alone_are_enough(shared_dir, tmp_path, capsys, command):
    data = shared_dir / "data" / "caliscope_4cam_hands"
    folder = tmp_path / "take"
    (folder / "frames").mkdir(parents=True)
    for frame in sorted((data / "frames").iterdir())[:2]:
        (folder / "frames" / frame.name).symlink_to(frame)
    rig = data / "calibration" / "rig.json"
    out = tmp_path / "out"
    name, *options = command
    assert main([name, str(folder), "--rig", str(rig), "--out", str(out), *options]) == 0
    hands = read_boxes(out / "keypoints.npz")
    assert hand_names(hands.hand_side) == ("right", "left")
    assert np.isfinite(hands.boxes_px).all()
    assert "4 of 4 hands in 2 frames" in capsys.readouterr().out
    assert (out / "index.html").is_file()
