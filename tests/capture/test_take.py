"""What a capture holds, and what is said of what is missing."""

import pytest

from poem_jax.capture.take import hand_names, read_take


def test_what_is_missing_is_said(make_capture, tmp_path):
    capture = make_capture()
    (capture.folder / "boxes.npz").rename(tmp_path / "elsewhere.npz")
    with pytest.raises(
        FileNotFoundError, match=r"no .*boxes\.npz: say where the hands are: an npz with `boxes_px"
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
