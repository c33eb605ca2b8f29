"""`reconstruct`: what is written, which laws hold, and what happens to bad frames."""

import json
import shutil

import cv2
import numpy as np
import pytest

from poem_jax.batch import Prediction
from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture import outputs, results
from poem_jax.capture.boxes_file import read_boxes, write_boxes
from poem_jax.capture.engine import Engine
from poem_jax.capture.pipeline import batch_size, reconstruct
from poem_jax.capture.take import hand_names, read_take
from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.io.meshes import read_mesh
from poem_jax.models.config import Config
from poem_jax.models.inference import Prepared
from poem_jax.viz.overlay import MeshInView, silhouette


def run(capture, out, engine, **options):
    return reconstruct(read_take(capture.folder), out, engine=engine, progress=False, **options)


def test_outputs_of_a_take(make_capture, tmp_path, engine):
    capture = make_capture(3, ("right", "left"), keypoints=True)
    written = run(capture, tmp_path / "out", engine)
    names = {path.relative_to(tmp_path / "out").as_posix() for path in written.files}
    frame_files = {f"{hand}{suffix}" for hand in ("right", "left") for suffix in (".glb", ".obj")}
    frame_files |= {f"overlay_{camera}.png" for camera in ("left_cam", "front", "cam 3")}
    expected = {f"{frame}/{name}" for frame in ("0000", "0003", "0006") for name in frame_files}
    assert names == expected | {"prediction.npz", "report.json", "index.html"}
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
            "reprojection_px": (3, 2, 3),
            "views_used": (3, 2, 3),
            "valid": (3, 2),
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
            read, faces = read_mesh(tmp_path / "out" / "0003" / f"{side}{suffix}")
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
    assert {"total", "read_and_crop", "first_batch_with_compilation"} <= report["timings_s"].keys()
    overlay = cv2.imread(str(tmp_path / "out" / "0003" / "overlay_front.png"))
    assert overlay.shape == (180, 240, 3)


def test_a_left_capture_is_the_mirrored_right_capture(make_capture, tmp_path, rig, engine):
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
    right_result = run(right, tmp_path / "right", engine)
    left_result = reconstruct(read_take(left), tmp_path / "left", engine=engine, progress=False)
    for name in ("vertices_world", "joints_world", "root_world"):
        np.testing.assert_allclose(
            left_result.arrays[name], right_result.arrays[name] * [-1, 1, 1], atol=2e-4
        )
    np.testing.assert_allclose(
        left_result.arrays["reprojection_px"], right_result.arrays["reprojection_px"], atol=0.1
    )


def test_the_prediction_moves_with_the_world(make_capture, tmp_path, rig, engine):
    capture = make_capture()
    before = run(capture, tmp_path / "a", engine).arrays
    angle = 0.7
    T_world_from_new = np.eye(4)
    T_world_from_new[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T_world_from_new[:3, 3] = [0.4, -1.0, 2.0]
    write_rig(
        capture.folder / "rig.json", rig._replace(T_cam_from_world=rig.T_cam_from_world @ T_world_from_new)
    )
    after = run(capture, tmp_path / "b", engine).arrays
    moved = after["vertices_world"] @ T_world_from_new[:3, :3].T + T_world_from_new[:3, 3]
    np.testing.assert_allclose(moved, before["vertices_world"], atol=1e-4)


def test_an_unseen_hand_is_nan_and_the_report_says_why(make_capture, tmp_path, engine):
    capture = make_capture(1, ("right", "left"))
    hands = capture.hands._replace(boxes_px=capture.hands.boxes_px.copy())
    hands.boxes_px[0, 1, 1:] = np.nan
    write_boxes(capture.folder / "boxes.npz", hands)
    written = run(capture, tmp_path / "out", engine)
    assert written.arrays["valid"].tolist() == [[True, False]]
    assert np.isnan(written.arrays["joints_world"][0, 1]).all()
    assert written.arrays["views_used"][0, 1].tolist() == [True, False, False]
    assert not (tmp_path / "out" / "0000" / "left.obj").exists()
    assert written.report["frames"][0]["hands"][1]["reason"] == "seen in 1 view(s); two are needed"
    hands.boxes_px[0, 0, 1:] = np.nan
    write_boxes(capture.folder / "boxes.npz", hands)
    with pytest.raises(ValueError, match="at least two views must see it; at most 1 of 3 do"):
        run(capture, tmp_path / "none", engine)


def test_bad_images_do_not_stop_a_take(make_capture, tmp_path, engine, caplog):
    capture = make_capture(3)
    places = [capture.folder / "frames" / name for name in ("0000", "0003", "0006")]
    (places[0] / "front.png").unlink()
    (places[1] / "front.png").write_bytes(b"broken")
    for path in places[2].glob("*.png"):
        path.write_bytes(b"broken")
    written = run(capture, tmp_path / "out", engine)
    assert written.arrays["valid"][:, 0].tolist() == [True, True, False]
    assert written.arrays["views_used"][:2, 0].tolist() == [[True, False, True]] * 2
    missing, broken, gone = written.report["frames"]
    assert "camera 'front' has a box but no image" in missing["image_problems"][0]
    assert "cannot be read as an image" in broken["image_problems"][0]
    assert len(gone["image_problems"]) == 3
    assert gone["hands"][0]["reason"] == "seen in 0 view(s); two are needed"
    assert written.report["failed_frames"] == 1
    assert not (tmp_path / "out" / "0006").exists()
    assert "frame 0003: an image is left out" in caplog.text


@pytest.mark.parametrize("num_frames", [1, 2])
def test_a_broken_image_that_nothing_needs_is_noted(make_capture, tmp_path, engine, num_frames):
    capture = make_capture(num_frames)
    capture.hands.boxes_px[:, :, 1] = np.nan
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    for path in capture.folder.rglob("front.png"):
        path.write_bytes(b"broken")
    written = run(capture, tmp_path / "out", engine)
    assert written.arrays["valid"].all()
    assert written.report["failed_frames"] == 0
    assert "cannot be read as an image" in written.report["frames"][0]["image_problems"][0]
    assert not list((tmp_path / "out").rglob("overlay_front.png"))


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
def test_a_wrong_rig_is_refused_for_the_whole_take(make_capture, tmp_path, rig, engine, spoil, message):
    beside = np.eye(4)
    beside[:3, 3] = 0.3, -0.2, 0.5  # about the hand itself a rig and its inverse may look alike
    capture = make_capture(4, ("right", "left"))
    moved = rig._replace(T_cam_from_world=rig.T_cam_from_world @ beside)
    write_rig(capture.folder / "rig.json", spoil(moved))
    with pytest.raises(ValueError, match=message):
        run(capture, tmp_path / "out", engine)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("num_frames", [1, 3])
def test_a_wrong_box_loses_one_hand_of_one_frame(make_capture, tmp_path, engine, caplog, num_frames):
    capture = make_capture(num_frames, ("right", "left"))
    capture.hands.boxes_px[-1, 0, 1] += [90, 0, 90, 0]
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    written = run(capture, tmp_path / "out", engine)
    expected = np.ones((num_frames, 2), bool)
    expected[-1, 0] = False
    assert written.arrays["valid"].tolist() == expected.tolist()
    reason = written.report["frames"][-1]["hands"][0]["reason"]
    assert reason.startswith("no point projects into the boxes of all views")
    assert "'front'" in reason
    assert reason.endswith("box or calibration?")
    assert "hand 'right' is left out: no point" in caplog.text


def test_the_page_of_a_long_take_is_thinned_among_the_frames_with_a_hand(
    make_capture, tmp_path, engine, monkeypatch
):
    pages = []
    monkeypatch.setattr(outputs, "PAGE_FRAMES", 2)
    monkeypatch.setattr(results, "write_page", lambda path, frames, *_: pages.append(frames) or path)
    capture = make_capture(7)
    capture.hands.boxes_px[::2] = np.nan
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    run(capture, tmp_path / "out", engine)
    assert [frame.name for frame in pages[0]] == ["0003", "0015"]
    assert all(frame.hands for frame in pages[0])


def test_a_page_that_cannot_be_recorded_costs_the_page_alone(
    make_capture, tmp_path, engine, monkeypatch, caplog
):
    def no_port(*_):
        raise OSError("no free port")

    monkeypatch.setattr(results, "write_page", no_port)
    run(make_capture(), tmp_path / "out", engine)
    assert (tmp_path / "out" / "report.json").exists()
    assert "the 3D page cannot be written, everything else is: no free port" in caplog.text


def test_a_new_run_removes_the_meshes_of_hands_that_it_lost(make_capture, tmp_path, engine):
    capture = make_capture(2, ("right", "left"))
    out = tmp_path / "out"
    run(capture, out, engine)
    mine = out / "0000" / "mine.obj"
    mine.write_text("not this command's")
    capture.hands.boxes_px[0, 1] = np.nan
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    run(capture, out, engine)
    meshes = {path.relative_to(out).as_posix() for path in out.rglob("*.obj")}
    assert meshes == {"0000/right.obj", "0000/mine.obj", "0003/right.obj", "0003/left.obj"}
    assert not (out / "0000" / "left.glb").exists()


def stub_engine(vertices, joints, root, valid=True):
    """An engine that gives known hands, one per sample and in the world of the samples."""

    def answer(_, views, cams):
        number = len(views)
        keypoints = np.full((*views.shape[:2], 1, 2), 32.0)
        layers = np.zeros((1, number, 799, 3))
        solved = valid & cams.view_mask.any(-1)
        return Prediction(vertices, joints, root, keypoints, layers, solved)

    config = Config(image_hw=(64, 64))
    params = {"constants": {"hand": {"faces": default_hand().faces}}}
    return Engine(config, Prepared(params, None, config), len(vertices), answer, "stub")


def known_hands(shift=0.0):
    """Vertices and joints (2, point, 3) of a right hand and a left one, in the capture's world."""
    pose = np.zeros((16, 3))
    pose[0] = 0.4, -0.8, 1.1
    meshes = [
        hand_mesh(default_hand(side), pose, np.zeros(10), np.array([x + shift, 0.01, 0.0]), center_joint=9)
        for side, x in (("right", -0.06), ("left", 0.06))
    ]
    return np.stack([mesh.vertices for mesh in meshes]), np.stack([mesh.joints for mesh in meshes])


def photograph(rig, view, points):
    """Project by the text book: Brown's polynomial, then K."""
    x, y, z = (points @ rig.T_cam_from_world[view, :3, :3].T + rig.T_cam_from_world[view, :3, 3]).T
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = rig.dist[view]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        np.ones_like(x),
    ]
    return (rig.K[view] @ bent)[:2].T, z


def test_overlays_and_errors_are_those_of_the_hands_given(make_capture, tmp_path, rig):
    capture = make_capture(1, ("right", "left"), keypoints=True)
    vertices, joints = known_hands()
    # The left hand's sample lives in the mirrored world.
    flip = np.array([[[1.0, 1, 1]], [[-1, 1, 1]]])
    engine = stub_engine(vertices * flip, joints * flip, joints[:, 9] * flip[:, 0])
    written = run(capture, tmp_path / "out", engine)
    np.testing.assert_allclose(written.arrays["vertices_world"][0], vertices, atol=1e-6)
    hands = written.report["frames"][0]["hands"]
    for view, camera in enumerate(rig.names):
        raw = cv2.imread(str(capture.folder / f"{camera}.png"))
        overlay = cv2.imread(str(tmp_path / "out" / "0000" / f"overlay_{camera}.png"))
        covered = np.zeros(raw.shape[:2], bool)
        for hand, side in enumerate(("right", "left")):
            uv, depth = photograph(rig, view, vertices[hand])
            corners = np.concatenate([uv, depth[:, None]], axis=-1)
            in_view = MeshInView(uv, corners, default_hand(side).faces, (0, 0, 0))
            covered |= silhouette([in_view], raw.shape[:2])
            expected = photograph(rig, view, joints[hand])[0] - capture.hands.keypoints_px[0, hand, view]
            error = np.linalg.norm(expected, axis=-1).mean()
            assert hands[hand]["reprojection_px"][camera] == pytest.approx(error, abs=1e-3)
            assert hands[hand]["joints_shown"][camera] == 1.0
        changed = (overlay != raw).any(-1)
        assert 300 < covered.sum() < 0.5 * covered.size
        assert not (changed & ~covered).any()
        assert changed[covered].mean() > 0.995


@pytest.mark.parametrize(
    ("shift", "valid", "reason"),
    [
        (0.0, False, "the views do not determine where the hand is"),
        (3.0, True, "the hand would lie behind camera 'left_cam'"),
    ],
)
def test_hands_without_a_believable_root_are_invalid(make_capture, tmp_path, shift, valid, reason):
    capture = make_capture()
    vertices, joints = known_hands(shift)
    engine = stub_engine(vertices[:1], joints[:1], joints[:1, 9], valid)
    with pytest.raises(ValueError, match=f"no hand could be reconstructed: {reason}"):
        run(capture, tmp_path / "out", engine)


def test_results_need_a_folder(make_capture, tmp_path, engine):
    capture = make_capture()
    (tmp_path / "file").write_text("keep")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match=r"the results go to a folder; .*file is a file: give another"):
            run(capture, out, engine)
    assert (tmp_path / "file").read_text() == "keep"


def test_the_only_frame_raises(make_capture, tmp_path, engine):
    capture = make_capture()
    (capture.folder / "front.png").unlink()
    with pytest.raises(FileNotFoundError, match="camera 'front' has a box but no image"):
        run(capture, tmp_path / "out", engine)
    (capture.folder / "front.png").write_bytes(b"broken")
    with pytest.raises(ValueError, match="cannot be read as an image"):
        run(capture, tmp_path / "out", engine)
    assert not (tmp_path / "out").exists()


def test_millimetres_called_metres_are_noticed(make_capture, tmp_path, rig, engine):
    capture = make_capture()
    T = rig.T_cam_from_world.copy()
    T[:, :3, 3] *= 1000
    write_rig(capture.folder / "rig.json", rig._replace(T_cam_from_world=T))
    with pytest.raises(ValueError, match="must be in metres; divide"):
        run(capture, tmp_path / "out", engine)


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


def test_without_viser_everything_else_is_written(make_capture, tmp_path, engine, monkeypatch, caplog):
    monkeypatch.setattr(results, "page_available", lambda: False)
    written = run(make_capture(), tmp_path / "out", engine)
    assert "index.html" not in {path.name for path in written.files}
    assert "pip install 'poem-jax[viz]'" in caplog.text
    assert (tmp_path / "out" / "report.json").exists()


def test_heat_maps_are_the_evidence_where_no_key_points_are_given(make_capture, tmp_path, engine):
    report = run(make_capture(), tmp_path / "out", engine).report
    assert report["reprojection"]["against"] == "the model's own heat maps"
    assert report["reprojection"]["mean_px"] >= 0


def test_names_and_batches(make_capture):
    assert hand_names(("right", "left")) == ("right", "left")
    assert hand_names(("right", "left", "right")) == ("right_0", "left", "right_1")
    take = read_take(make_capture(3, ("right", "left")).folder)
    assert batch_size(take) == 4
    one = read_take(make_capture(1, ("right",), name="one").folder)
    assert batch_size(one) == 1
    assert read_boxes(make_capture(1, name="two").folder / "boxes.npz").keypoints_px is None
