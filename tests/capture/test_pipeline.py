"""The whole line by a network: what is written, and which laws hold."""

import json
import shutil

import cv2
import numpy as np
import pytest

from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture.boxes_file import write_boxes
from poem_jax.io.meshes import read_mesh


@pytest.mark.parametrize("meshes", [True, False])
def test_outputs_of_a_take(make_capture, tmp_path, meshes, run):
    capture = make_capture(3, ("right", "left"), keypoints=True)
    written = run(capture, tmp_path / "out", meshes=True if meshes else None)
    names = {path.relative_to(tmp_path / "out").as_posix() for path in written.files}
    frame_files = {f"overlay_{camera}.png" for camera in ("left_cam", "front", "cam 3")}
    if meshes:
        frame_files |= {f"{hand}{suffix}" for hand in ("right", "left") for suffix in (".glb", ".obj")}
    expected = {f"{frame}/{name}" for frame in ("0000", "0003", "0006") for name in frame_files}
    assert names == expected | {"prediction.npz", "report.json", "index.html", "hands.glb"}
    on_disk = {
        p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*") if p.is_file()
    }
    assert on_disk == names

    with np.load(tmp_path / "out" / "prediction.npz") as arrays:
        shapes = {name: arrays[name].shape for name in arrays}
        assert shapes == {
            "joints_world": (3, 2, 21, 3),
            "vertices_world": (3, 2, 778, 3),
            "root_world": (3, 2, 3),
            "joint_sigma_m": (3, 2, 21),
            "joint_confidence": (3, 2, 3, 21),
            "reprojection_px": (3, 2, 3),
            "views_used": (3, 2, 3),
            "valid": (3, 2),
            "bridged": (3, 2),
            "time_s": (3,),
            "frames": (3,),
            "hand_side": (2,),
            "cameras": (3,),
        }
        assert arrays["valid"].all()
        assert np.isfinite(arrays["vertices_world"]).all()
        vertices = arrays["vertices_world"]
        assert arrays["frames"].tolist() == ["0000", "0003", "0006"]
    for hand, side in enumerate(("right", "left")):
        for suffix in (".glb", ".obj"):
            path = tmp_path / "out" / "0003" / f"{side}{suffix}"
            assert path.exists() == meshes
            if not meshes:
                continue
            read, faces = read_mesh(path)
            np.testing.assert_allclose(read, vertices[1, hand], atol=1e-6)
            # The boundary is the wrist; a mesh turned inside out would have a negative volume.
            corners = read[faces] - read.mean(0)
            volume = np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]) / 6
            assert volume > 0

    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["reprojection"]["against"] == "the key points given"
    assert report["failed_frames"] == 0
    first = report["frames"][0]["hands"][0]
    assert first["views_used"] == ["left_cam", "front", "cam 3"]
    assert first["reprojection_px"].keys() == {"left_cam", "front", "cam 3"}
    assert {"total", "judge_boxes", "read", "crop", "predict", "judge", "write"} <= report["timings_s"].keys()
    overlay = cv2.imread(str(tmp_path / "out" / "0003" / "overlay_front.png"))
    assert overlay.shape == (180, 240, 3)


def test_a_left_capture_is_the_mirrored_right_capture(make_capture, tmp_path, rig, run):
    """Flip the images, mirror the world: the other hand comes out mirrored, whatever the parameters."""
    right = make_capture(1, ("right",))
    d = np.diag([-1.0, 1, 1, 1])
    K = rig.K.copy()
    K[:, 0, 2], K[:, 0, 1] = 240 - K[:, 0, 2], -K[:, 0, 1]
    mirrored = rig._replace(
        K=K, dist=rig.dist * [1, 1, 1, -1, 1], T_cam_from_world=d @ rig.T_cam_from_world @ d
    )
    left = right.folder.parent / "mirrored"
    shutil.copytree(right.folder, left)
    for path in left.glob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path))[:, ::-1])
    boxes = right.hands.boxes_px[..., [2, 1, 0, 3]] * [-1, 1, -1, 1] + [240, 0, 240, 0]
    write_boxes(left / "boxes.npz", right.hands._replace(boxes_px=boxes, hand_side=("left",)))
    write_rig(left / "rig.json", mirrored)
    right_result = run(right, tmp_path / "right")
    left_result = run(right._replace(folder=left), tmp_path / "left")
    for name in ("vertices_world", "joints_world", "root_world"):
        np.testing.assert_allclose(
            left_result.arrays[name], right_result.arrays[name] * [-1, 1, 1], atol=2e-4
        )
    np.testing.assert_allclose(
        left_result.arrays["reprojection_px"], right_result.arrays["reprojection_px"], atol=0.1
    )


def test_the_prediction_moves_with_the_world(make_capture, tmp_path, rig, run):
    capture = make_capture()
    before = run(capture, tmp_path / "a").arrays
    angle = 0.7
    T_world_from_new = np.eye(4)
    T_world_from_new[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T_world_from_new[:3, 3] = [0.4, -1.0, 2.0]
    write_rig(
        capture.folder / "rig.json", rig._replace(T_cam_from_world=rig.T_cam_from_world @ T_world_from_new)
    )
    after = run(capture, tmp_path / "b").arrays
    moved = after["vertices_world"] @ T_world_from_new[:3, :3].T + T_world_from_new[:3, 3]
    np.testing.assert_allclose(moved, before["vertices_world"], atol=1e-4)


def test_an_unseen_hand_is_nan_and_the_report_says_why(make_capture, tmp_path, run):
    capture = make_capture(1, ("right", "left"))
    hands = capture.hands._replace(boxes_px=capture.hands.boxes_px.copy())
    hands.boxes_px[0, 1, 1:] = np.nan
    write_boxes(capture.folder / "boxes.npz", hands)
    written = run(capture, tmp_path / "out")
    assert written.arrays["valid"].tolist() == [[True, False]]
    assert np.isnan(written.arrays["joints_world"][0, 1]).all()
    assert written.arrays["views_used"][0, 1].tolist() == [True, False, False]
    assert not (tmp_path / "out" / "0000" / "left.obj").exists()
    assert written.report["frames"][0]["hands"][1]["reason"] == "seen in 1 view(s); two are needed"
    hands.boxes_px[0, 0, 1:] = np.nan
    write_boxes(capture.folder / "boxes.npz", hands)
    with pytest.raises(ValueError, match="at least two views must see it; at most 1 of 3 do"):
        run(capture, tmp_path / "none")
