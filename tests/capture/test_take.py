"""What a capture holds, and what is said of what is missing."""

import pytest

from poem_jax.capture.boxes_file import write_boxes
from poem_jax.capture.take import read_keypoint_take, read_take
from poem_jax.data.capture_folder import hand_names


def test_what_is_missing_is_said(make_capture, tmp_path):
    capture = make_capture()
    (capture.folder / "boxes.npz").rename(tmp_path / "elsewhere.npz")
    with pytest.raises(
        FileNotFoundError, match=r"no .*keypoints\.npz: say where the hands are: an npz with `boxes_px"
    ):
        read_take(capture.folder)
    assert len(read_take(capture.folder, boxes=tmp_path / "elsewhere.npz").frames) == 1
    (capture.folder / "calibration").mkdir()
    (capture.folder / "rig.json").rename(capture.folder / "calibration" / "rig.json")
    assert len(read_take(capture.folder, boxes=tmp_path / "elsewhere.npz").frames) == 1
    (capture.folder / "calibration" / "rig.json").rename(tmp_path / "rig.json")
    with pytest.raises(FileNotFoundError, match="no rig: pass --rig FILE"):
        read_take(capture.folder, boxes=tmp_path / "elsewhere.npz")
    assert read_take(capture.folder, tmp_path / "rig.json", tmp_path / "elsewhere.npz").rig.num_views == 3
    with pytest.raises(FileNotFoundError, match="no capture folder"):
        read_take(tmp_path / "nowhere")


def test_names_of_hands():
    assert hand_names(("right", "left")) == ("right", "left")
    assert hand_names(("right", "left", "right")) == ("right_0", "left", "right_1")


def test_two_frames_of_one_number(make_capture):
    """Boxes are matched by number: those of frame 3 would be taken for both."""
    capture = make_capture(2)
    (capture.folder / "frames" / "3").mkdir()
    with pytest.raises(ValueError, match=r"different numbers; '0?0?0?3' and '0?0?0?3' have one: rename one"):
        read_take(capture.folder)


def test_images_of_frames_without_names_are_said_to_be_taken_by_number(make_capture, caplog):
    capture = make_capture(3, keypoints=True)
    two = capture.hands._replace(
        frames=None, boxes_px=capture.hands.boxes_px[:2], keypoints_px=capture.hands.keypoints_px[:2]
    )
    file = write_boxes(capture.folder / "keypoints.npz", two)
    take = read_keypoint_take(file, images=capture.folder)
    assert "names none of its 2 frames, and" in caplog.text
    assert [frame.name for frame in take.frames] == ["0000", "0001"]
