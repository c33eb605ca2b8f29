"""Boxes and rig that do not fit together: the take is refused, or one hand left out."""

import numpy as np
import pytest

from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture.boxes_file import write_boxes
from poem_jax.geometry.transforms import rotation_from_axis_angle


def _twice_the_resolution(rig):
    return rig._replace(K=rig.K * [[2.0], [2.0], [1.0]])


def _inverted(rig):
    return rig._replace(T_cam_from_world=np.linalg.inv(rig.T_cam_from_world))


def _one_camera_turned(rig):
    T = rig.T_cam_from_world.copy()
    T[1, :3] = rotation_from_axis_angle(np.array([0.0, 0.4, 0.0])) @ T[1, :3]
    return rig._replace(T_cam_from_world=T)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_inverted, "pass the inverses"),
        (_twice_the_resolution, "the rig does not fit the boxes: for 8 of 8 hands"),
        (_one_camera_turned, "without camera .*'front' there is one; check that K belongs"),
    ],
)
def test_a_wrong_rig_is_refused_for_the_whole_take(make_capture, tmp_path, rig, run, spoil, message):
    beside = np.eye(4)
    beside[:3, 3] = 0.3, -0.2, 0.5  # about the hand itself a rig and its inverse may look alike
    capture = make_capture(4, ("right", "left"))
    moved = rig._replace(T_cam_from_world=rig.T_cam_from_world @ beside)
    write_rig(capture.folder / "rig.json", spoil(moved))
    with pytest.raises(ValueError, match=message):
        run(capture, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("num_frames", [1, 3])
def test_a_wrong_box_loses_one_hand_of_one_frame(make_capture, tmp_path, run, caplog, num_frames):
    capture = make_capture(num_frames, ("right", "left"))
    capture.hands.boxes_px[-1, 0, 1] += [90, 0, 90, 0]
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    written = run(capture, tmp_path / "out")
    expected = np.ones((num_frames, 2), bool)
    expected[-1, 0] = False
    assert written.arrays["valid"].tolist() == expected.tolist()
    reason = written.report["frames"][-1]["hands"][0]["reason"]
    assert reason.startswith("no point projects into the boxes of all views")
    assert "'front'" in reason
    assert reason.endswith("box or calibration?")
    assert "hand 'right' is left out: no point" in caplog.text


def test_millimetres_called_metres_are_noticed(make_capture, tmp_path, rig, run):
    capture = make_capture()
    T = rig.T_cam_from_world.copy()
    T[:, :3, 3] *= 1000
    write_rig(capture.folder / "rig.json", rig._replace(T_cam_from_world=T))
    with pytest.raises(ValueError, match="must be in metres; divide"):
        run(capture, tmp_path / "out")
