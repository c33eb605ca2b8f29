"""`poem fit`: what comes of key points, and what is said of those that cannot be right."""

import json
import logging
import re

import cv2
import jax
import numpy as np
import pytest

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture import fit as fitting_stage
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints, write_boxes
from poem_jax.capture.fit import _windows, fit_hands
from poem_jax.capture.frame import Frame
from poem_jax.capture.frame_padding import FRAMES_TOGETHER, padded_frames
from poem_jax.capture.pipeline import fit, reconstruct
from poem_jax.capture.smoothing import Smoothing
from poem_jax.capture.take import Take, make_take, read_keypoint_take, read_take
from poem_jax.cli import main
from poem_jax.data.capture_folder import FramePaths
from poem_jax.geometry.distortion import distort_pixels, fisheye_lens, stack_lenses
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid, rotation_from_axis_angle
from poem_jax.geometry.world_origin import move_origin
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.pair import hands_of
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import OPENPOSE_FROM_MANO
from poem_jax.synthetic.keypoint_takes import draw_keypoint_take
from tests.calibration.test_linter import moving_take
from tests.capture.stub_network import lost_network

FRAMES, VIEWS, SIDES = 6, 4, ("right", "left")


@pytest.fixture(scope="module")
def truth():
    """Both hands of a take, each with its own truth, in one rig with lenses."""
    takes = [draw_keypoint_take(default_hand(side), FRAMES, VIEWS, 0.5, 40) for side in SIDES]
    return np.stack([take.joints for take in takes], 1), np.stack([take.vertices for take in takes], 1), takes


@pytest.fixture(scope="module")
def take(truth) -> Take:
    _, _, takes = truth
    rig = Rig(
        tuple(f"cam_{view}" for view in range(VIEWS)),
        np.tile([1280, 720], (VIEWS, 1)),
        takes[0].K.astype(np.float64),
        np.array([[-0.3, 0.1, 1e-3, -2e-3, 0.02 * view] for view in range(VIEWS)]),
        takes[0].T_cam_from_world.astype(np.float64),
    )
    ideal = np.stack([t.uv_px for t in takes], 1).astype(np.float64)
    raw = [
        distort_pixels(ideal[:, :, view].reshape(-1, 2), rig.K[view], rig.dist[view]) for view in range(VIEWS)
    ]
    return with_keypoints(rig, np.stack([x.reshape(FRAMES, 2, 21, 2) for x in raw], 2))


def with_keypoints(rig: Rig, keypoints: np.ndarray, sides=SIDES, confidence=None) -> Take:
    frames = tuple(f"{frame:04d}" for frame in range(len(keypoints)))
    hands = HandBoxes(boxes_from_keypoints(keypoints), sides, frames, keypoints, confidence)
    return make_take(rig, [FramePaths(name, (None,) * rig.num_views) for name in frames], hands)


def changed(take: Take, **changes) -> Take:
    """The take with other boxes, key points, confidence or sides."""
    return make_take(take.rig, take.frames.paths, take.frames.hands._replace(**changes))


def error_mm(arrays, truth) -> np.ndarray:
    return 1000 * np.linalg.norm(arrays["joints_world"] - truth[0], axis=-1)


@pytest.fixture(scope="module")
def fitted(take, tmp_path_factory):
    return fit(take, tmp_path_factory.mktemp("out"), progress=False)


def test_both_hands_are_found(fitted, truth):
    assert fitted.arrays["valid"].all()
    assert np.median(error_mm(fitted.arrays, truth)) < 1
    assert error_mm(fitted.arrays, truth).max() < 6


def test_the_arrays_are_those_of_one_hand_model(fitted):
    """Pose, shape and place give the mesh; the uncertainty is a number of millimetres."""
    hands = hands_of(default_hand())
    for index, side in enumerate(SIDES):
        pose, shape, place = (fitted.arrays[n][:, index] for n in ("pose", "shape", "translation"))
        mesh = hand_mesh(hands.of(side), pose, shape, place)
        np.testing.assert_allclose(mesh.vertices, fitted.arrays["vertices_world"][:, index], atol=1e-5)
        np.testing.assert_array_equal(shape, np.tile(shape[:1], (FRAMES, 1)))
    assert (fitted.arrays["joint_sigma_m"] > 1e-5).all()
    assert (fitted.arrays["joint_sigma_m"] < 5e-3).all()


def test_the_report_says_what_was_done(fitted):
    assert fitted.report["engine"] == "fit"
    hand = fitted.report["frames"][0]["hands"][1]
    assert hand["hand"] == "left"
    assert len(hand["joint_sigma_mm"]) == 21
    assert fitted.report["reprojection"]["median_px"] < 2


def test_one_bad_frame_is_marked(take, fitted, tmp_path, truth):
    keypoints = take.frames.hands.keypoints_px.copy()
    keypoints[2, 0] = np.nan
    written = fit(changed(take, keypoints_px=keypoints), tmp_path, progress=False)
    assert written.report["failed_frames"] == 0, "the other hand was found"
    lost = written.report["frames"][2]["hands"][0]
    assert not lost["valid"]
    assert lost["reason"] == "seen in 0 view(s); two are needed"
    assert np.isnan(written.arrays["joints_world"][2, 0]).all()
    assert written.arrays["valid"].sum() == 2 * FRAMES - 1
    assert np.nanmedian(error_mm(written.arrays, truth)) < 1.1


def test_nan_confidence_counts_as_unseen(take, tmp_path):
    """A key point with NaN confidence may be anywhere."""
    confidence = np.ones(take.frames.hands.keypoints_px.shape[:-1])
    confidence[:, :, 1, 8] = np.nan
    moved = take.frames.hands.keypoints_px.copy()
    moved[:, :, 1, 8] += 15.0
    one, other = (
        fit(changed(take, keypoints_px=k, confidence=confidence), tmp_path / name, progress=False).arrays
        for name, k in (("a", take.frames.hands.keypoints_px), ("b", moved))
    )
    np.testing.assert_allclose(one["joints_world"], other["joints_world"], atol=1e-6)


def test_a_world_in_map_coordinates_gives_the_same_hands(take, fitted, tmp_path):
    origin = np.array([500e3, 4500e3, 300.0])
    rig = take.rig._replace(T_cam_from_world=move_origin(take.rig.T_cam_from_world, -origin))
    arrays = fit(take._replace(rig=rig), tmp_path, progress=False).arrays
    for name in ("joints_world", "vertices_world", "root_world", "translation"):
        assert arrays[name].dtype == np.float64
        np.testing.assert_allclose(arrays[name] - origin, fitted.arrays[name], atol=1e-4)


def test_millimetres_called_metres_are_refused(take, tmp_path):
    T = take.rig.T_cam_from_world.copy()
    T[:, :3, 3] *= 1000
    with pytest.raises(ValueError, match=r"not metres.*one unit .* about") as told:
        fit(take._replace(rig=take.rig._replace(T_cam_from_world=T)), tmp_path, progress=False)
    assert 0.8 < float(re.search(r"about (\S+) mm", str(told.value))[1]) < 1.2
    assert not list(tmp_path.iterdir())


def test_a_wrong_unit_is_refused_where_hands_come_late(take, tmp_path):
    """The first frames show no hand, by which a rig could be judged."""
    keypoints = take.frames.hands.keypoints_px
    nothing = np.full((FRAMES_TOGETHER, *keypoints.shape[1:]), np.nan)
    T = take.rig.T_cam_from_world.copy()
    T[:, :3, 3] *= 1000
    late = with_keypoints(take.rig._replace(T_cam_from_world=T), np.concatenate([nothing, keypoints]))
    with pytest.raises(ValueError, match=r"not metres.*one unit .* about"):
        fit(late, tmp_path, progress=False)
    assert not list(tmp_path.iterdir())


def test_inverse_extrinsics_are_refused(take, tmp_path):
    wrong = take.rig._replace(T_cam_from_world=invert_rigid(take.rig.T_cam_from_world))
    with pytest.raises(ValueError, match="inverse"):
        fit(take._replace(rig=wrong), tmp_path, progress=False)


def test_nothing_seen_by_two_views_is_an_error(take, tmp_path):
    keypoints = take.frames.hands.keypoints_px.copy()
    keypoints[:, :, 1:] = np.nan
    lonely = changed(take, keypoints_px=keypoints, boxes_px=boxes_from_keypoints(keypoints))
    with pytest.raises(ValueError, match="at least two views"):
        fit(lonely, tmp_path, progress=False)


def test_boxes_alone_are_not_enough(take, tmp_path):
    with pytest.raises(ValueError, match="boxes only"):
        fit(changed(take, keypoints_px=None), tmp_path, progress=False)


def test_one_camera_is_not_enough(take, tmp_path):
    lonely = changed(take, keypoints_px=take.frames.hands.keypoints_px[:, :, :1])
    with pytest.raises(ValueError, match="at least two views; the rig has 1"):
        fit(lonely._replace(rig=take.rig.select(["cam_0"])), tmp_path, progress=False)


def test_a_turned_camera_is_named(take, tmp_path, caplog):
    T = take.rig.T_cam_from_world.copy()
    T[2, :3] = rotation_from_axis_angle(np.array([0.05, 0.05, 0.0])) @ T[2, :3]
    with caplog.at_level(logging.WARNING):
        written = fit(take._replace(rig=take.rig._replace(T_cam_from_world=T)), tmp_path, progress=False)
    said = written.report["warnings"][0]
    assert said in caplog.text
    assert "camera 'cam_2' alone" in said
    assert "turned by 4.1 degrees" in said
    assert not any(f"'cam_{view}'" in said for view in (0, 1, 3))
    assert written.arrays["valid"].all()


def test_a_camera_that_was_late_is_named_where_the_views_agree(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(fitting_stage, "judge_views", lambda *_, **__: [])
    rig, keypoints = moving_take((0.0, 0.8, 0.0, 0.0))
    frames = tuple(f"{frame:04d}" for frame in range(len(keypoints)))
    hands = HandBoxes(boxes_from_keypoints(keypoints), ("right",), frames, keypoints)
    timed = hands._replace(time_s=np.arange(len(keypoints)) / 25)
    for given, said in ((timed, 1), (hands, 0)):
        caplog.clear()
        paths = [FramePaths(name, (None,) * rig.num_views) for name in frames]
        with caplog.at_level(logging.WARNING):
            fit(make_take(rig, paths, given), tmp_path, progress=False)
        assert caplog.text.count("not of one moment: 'front' +0.8") == said


def test_a_right_rig_is_not_complained_about(take, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        fit(take, tmp_path, progress=False)
    assert not caplog.records


def test_the_wrong_side_is_noticed(take, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        fit(changed(take, hand_side=SIDES[::-1]), tmp_path, progress=False)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2
    assert all("other side" in text and "hand_side" in text for text in said)


def test_the_wrong_order_of_joints_is_noticed(take, tmp_path, caplog):
    mano_order = np.argsort(OPENPOSE_FROM_MANO)
    keypoints = take.frames.hands.keypoints_px[..., mano_order, :]
    with caplog.at_level(logging.WARNING):
        fit(changed(take, keypoints_px=keypoints), tmp_path, progress=False)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2
    assert all("OpenPose order" in text for text in said)


@pytest.fixture
def files(take, tmp_path):
    """The take as files, with images, one of them damaged; frame 2 has none."""
    keypoints = write_boxes(tmp_path / "keypoints.npz", take.frames.hands)
    rig = write_rig(tmp_path / "rig.json", take.rig)
    for frame in take.frames.hands.frames:
        folder = tmp_path / "capture" / "frames" / frame
        folder.mkdir(parents=True)
        for name in take.rig.names if frame != "0002" else ():
            cv2.imwrite(str(folder / f"{name}.jpg"), np.full((720, 1280, 3), 90, np.uint8))
    (tmp_path / "capture" / "frames" / "0003" / "cam_1.jpg").write_bytes(b"\xff\xd8")
    return keypoints, rig, tmp_path / "capture"


def test_the_command_writes_what_reconstruct_writes(files, fitted, tmp_path, capsys):
    keypoints, rig, images = files
    out = tmp_path / "out"
    assert main(["fit", str(keypoints), "--rig", str(rig), "--out", str(out), "--images", str(images)]) == 0
    assert "12 of 12 hands in 6 frames" in capsys.readouterr().out
    arrays = np.load(out / "prediction.npz")
    np.testing.assert_allclose(arrays["joints_world"], fitted.arrays["joints_world"], atol=1e-4)
    report = json.loads((out / "report.json").read_text())
    assert "cam_1.jpg" in report["frames"][3]["image_problems"][0]
    overlays = sorted(path.relative_to(out).as_posix() for path in out.glob("*/overlay_*.png"))
    assert len(overlays) == (FRAMES - 1) * VIEWS - 1
    assert not list(out.glob("*/left.glb")), "meshes of every frame are written on request"
    assert (out / "hands.glb").is_file()
    drawn = cv2.imread(str(out / "0001" / "overlay_cam_0.png"))
    assert (drawn != 90).any()


def test_reconstruct_with_the_fit_as_engine(files, tmp_path, capsys):
    keypoints, rig, images = files
    arguments = ["reconstruct", str(images), "--rig", str(rig), "--boxes", str(keypoints), "--out"]
    formats = ["--formats", "glb,bvh,csv,trc,mano"]
    assert main([*arguments, str(tmp_path / "out"), "--engine", "fit", *formats]) == 0
    said = capsys.readouterr()
    assert "12 of 12 hands in 6 frames" in said.out
    for name in (
        "hands.glb",
        "right.bvh",
        "left.bvh",
        "joints.csv",
        "joint_angles.csv",
        "hands.trc",
        "mano.npz",
    ):
        assert name in said.out
        assert (tmp_path / "out" / name).is_file()
    assert (
        json.loads((tmp_path / "out" / "report.json").read_text())["animation"]["left"]["moves_by"]
        == "skeleton"
    )
    assert main([*arguments, str(tmp_path / "out"), "--formats", "fbx"]) == 2
    assert "--formats must be a list of glb, bvh" in capsys.readouterr().err
    assert main([*arguments, str(tmp_path / "out"), "--engine", "fit", "--checkpoint", "ckpt"]) == 2
    assert "a fit has no weights" in capsys.readouterr().err
    assert main([*arguments, str(tmp_path / "out"), "--engine", "poem", "--mano", "hand.npz"]) == 2
    assert "for --engine fit" in capsys.readouterr().err
    assert main([*arguments, str(tmp_path / "out"), "--bridge", "0.1"]) == 2
    assert "--bridge goes with --smooth" in capsys.readouterr().err


def test_of_both_engines_the_better_one_is_taken(files, fitted, tmp_path):
    """The images show nothing, so that the network loses every hand; the fit does the take."""
    keypoints, rig, images = files
    take = read_take(images, rig, keypoints)
    written = reconstruct(take, tmp_path / "out", network=lost_network(), progress=False)
    choice = written.report["engine_choice"]
    assert written.report["engine"] == choice["engine"] == "fit"
    assert choice["by"] == "views left out"
    assert choice["figures"]["fit"]["left_out_px"] < 3
    assert choice["figures"]["poem"] == {"left_out_px": None, "hands_lost": 1.0}
    assert written.report["timings_s"]["choose_engine"] > 0
    np.testing.assert_allclose(
        written.arrays["joints_world"],
        fitted.arrays["joints_world"],
        atol=1e-4,
    )


def test_a_fit_that_is_not_smoothed_asks_for_no_times(take):
    """A file of key points may know when some of its frames were taken."""
    frames = [frame._replace(time_s=9.0 if i == 2 else None) for i, frame in enumerate(take.frames)]
    found = fit_hands(iter(frames), take, hands_of(default_hand()))
    assert all(hand.reason is None for frame in found for hand in frame.hands)
    with pytest.raises(ValueError, match="must have times, or none"):
        list(fit_hands(iter(frames), take, hands_of(default_hand()), smooth=True))


def test_a_key_point_that_is_off_is_not_borne_out(take):
    """0 for the one that no other view agrees with, about 0.9 for the others, NaN for those unseen."""
    keypoints = take.frames.hands.keypoints_px.copy()
    keypoints[2, 0, 1, 8] += 40.0
    keypoints[2, 0, 3, 4] = np.nan
    confidence = np.ones(keypoints.shape[:-1])
    confidence[2, 0, 0] = 0.5
    changed_take = changed(take, keypoints_px=keypoints, confidence=confidence)
    frames = list(fit_hands(changed_take.frames, changed_take, hands_of(default_hand())))
    trust = frames[2].hands[0].joint_confidence
    assert trust.shape == (VIEWS, 21)
    assert trust[1, 8] == 0
    assert np.isnan(trust[3, 4])
    assert np.isnan(trust).sum() == 1
    assert 0.7 < np.median(trust[2]) < 1
    assert np.median(trust[0]) == pytest.approx(0.5 * np.median(trust[2]), abs=0.1)
    everything = np.stack([hand.joint_confidence for frame in frames for hand in frame.hands])
    assert np.nanmax(everything) <= 1
    assert np.nanmin(everything) >= 0


def test_key_points_and_rig_of_different_views_are_refused(files, take, tmp_path):
    keypoints, _, _ = files
    rig = write_rig(tmp_path / "three.json", take.rig.select(["cam_0", "cam_1", "cam_2"]))
    with pytest.raises(ValueError, match="the rig has 3 views"):
        read_keypoint_take(keypoints, rig)


def test_images_of_other_frames_are_refused(files, tmp_path):
    keypoints, rig, images = files
    for frame in ("0000", "0001", "0002", "0003", "0004", "0005"):
        (images / "frames" / frame).rename(images / "frames" / f"take2_{frame}")
    with pytest.raises(ValueError, match="no frame of it"):
        read_keypoint_take(keypoints, rig, images)


def test_points_beyond_the_fold_of_a_lens_are_dropped(take):
    keypoints = take.frames.hands.keypoints_px.copy()
    keypoints[0, 0, 0, 0] = 2e4, 1e4
    ideal = ideal_keypoints(take.rig, keypoints)
    assert np.isnan(ideal[0, 0, 0, 0]).all()
    assert np.isnan(ideal).sum() == 2


@pytest.mark.slow
def test_the_same_hands_are_found_through_fisheyes_and_other_lenses(take, fitted, truth, tmp_path):
    """A rig of mixed lenses; what a fisheye sees too far aside is left out, and said."""
    lenses = [fisheye_lens(np.array([0.05, -0.02, 0.004, -0.001]))] * 2
    lenses += [np.array([0.5, 0.1, 1e-3, -2e-3, 0.01, 0.6, 0.05, 1e-3, 1e-3, 0, -1e-3, 0, 0.02, -0.01])] * 2
    rig = take.rig._replace(dist=stack_lenses(lenses))
    ideal = np.moveaxis(ideal_keypoints(take.rig, take.frames.hands.keypoints_px), 2, 0)
    raw = distort_pixels(ideal.reshape(VIEWS, -1, 2), rig.K, rig.dist).reshape(ideal.shape)
    keypoints = np.moveaxis(raw, 0, 2).copy()
    keypoints[0, 0, 0, 3] = rig.K[0, :2, 2] + [1.6 * rig.K[0, 0, 0], 0]
    arrays = fit(with_keypoints(rig, keypoints), tmp_path, progress=False).arrays
    assert np.abs(error_mm(arrays, truth) - error_mm(fitted.arrays, truth))[1:].max() < 0.5
    warnings = json.loads((tmp_path / "report.json").read_text())["warnings"]
    assert [
        w for w in warnings if "camera 'cam_0': 1 key points lie where its fisheye looks more than 85" in w
    ]


def test_hands_outside_their_image_are_not_fitted(files, take, tmp_path, caplog):
    keypoints = take.frames.hands.keypoints_px.copy()
    keypoints[1, 0, 2, :, 0] -= 5000
    moved = write_boxes(
        tmp_path / "moved.npz",
        take.frames.hands._replace(keypoints_px=keypoints, boxes_px=boxes_from_keypoints(keypoints)),
    )
    found = read_keypoint_take(moved, files[1])
    assert np.isnan(found.frames.hands.keypoints_px[1, 0, 2]).all()
    assert "outside" in caplog.text


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_users_own_hand(files, fitted, tmp_path, side):
    """The shipped hand as the user's file, of either side, gives the same hands."""
    keypoints, rig, _ = files
    hand = default_hand(side)._asdict()
    fields = {"f" if name == "faces" else name: value for name, value in hand.items() if name != "is_left"}
    np.savez(tmp_path / f"my_{side}.npz", **fields)
    command = ["fit", str(keypoints), "--rig", str(rig), "--out", str(tmp_path / "out"), "--mano"]
    assert main([*command, str(tmp_path / f"my_{side}.npz")]) == 0
    own = np.load(tmp_path / "out" / "prediction.npz")
    np.testing.assert_allclose(own["vertices_world"], fitted.arrays["vertices_world"], atol=1e-4)
    assert main([*command, str(tmp_path / "missing.pkl")]) == 2


@pytest.mark.parametrize("name", ["prediction.npz", "report.json"])
def test_the_results_do_not_replace_what_they_come_from(files, tmp_path, capsys, name):
    keypoints, rig, _ = files
    mine = tmp_path / "out" / name
    mine.parent.mkdir()
    content = (keypoints if name == "prediction.npz" else rig).read_bytes()
    mine.write_bytes(content)
    given = {"prediction.npz": [mine, "--rig", rig], "report.json": [keypoints, "--rig", mine]}[name]
    assert main(["fit", *map(str, given), "--out", str(mine.parent)]) == 2
    assert f"{name} would be replaced by a result, and is read; give another --out" in capsys.readouterr().err
    assert mine.read_bytes() == content
    command = ["reconstruct", str(tmp_path), "--rig", str(mine), "--out", str(mine.parent)]
    assert main(command) == 2
    assert "would be replaced by a result" in capsys.readouterr().err


@pytest.mark.slow
def test_smoothing_from_the_command_line(files, fitted, tmp_path):
    """On record; frames that have nothing to do with each other stay where they are."""
    keypoints, rig, _ = files
    out = tmp_path / "out"
    assert main(["fit", str(keypoints), "--rig", str(rig), "--out", str(out), "--smooth"]) == 0
    said = json.loads((out / "report.json").read_text())["smoothing"]
    assert (said["mode"], said["bridge_s"], said["bridged_hands"]) == ("offline", 0.2, 0)
    assert 0 < said["jitter_after_mm"] <= 1.01 * said["jitter_before_mm"]
    smooth = np.load(out / "prediction.npz")
    assert smooth["valid"].all()
    moved = np.linalg.norm(smooth["joints_world"] - fitted.arrays["joints_world"], axis=-1)
    assert 0 < np.median(moved) < 5e-4


@pytest.fixture
def compilations():
    """What JAX compiles from here on."""
    heard = []

    def listen(event, duration, **_):
        if "backend_compile" in event:
            heard.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    return heard


def longer(take: Take, count: int) -> Take:
    """The frames of a take again and again."""
    keypoints = take.frames.hands.keypoints_px
    return with_keypoints(take.rig, np.resize(keypoints, (count, *keypoints.shape[1:])))


@pytest.mark.slow
def test_takes_of_any_length_share_compiled_programs(take, tmp_path, compilations):
    """A take of more than one group compiles all that there is."""
    fit(longer(take, FRAMES_TOGETHER + 2), tmp_path / "more", progress=False)
    before = len(compilations)
    for count in (3, 7, 2 * FRAMES_TOGETHER + 9):
        fit(longer(take, count), tmp_path / str(count), progress=False)
    assert len(compilations) == before


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [False, True])
def test_a_long_take_is_fitted_group_by_group_with_one_shape(take, tmp_path, truth, smooth):
    count = 2 * FRAMES_TOGETHER + 9
    smoothing = Smoothing("offline" if smooth else "off")
    written = fit(longer(take, count), tmp_path, progress=False, smoothing=smoothing)
    arrays = written.arrays
    assert arrays["frames"].tolist() == [f"{frame:04d}" for frame in range(count)]
    assert arrays["valid"].all()
    np.testing.assert_array_equal(arrays["shape"], np.tile(arrays["shape"][:1], (count, 1, 1)))
    again = (np.resize(truth[0], (count, *truth[0].shape[1:])),)
    assert np.median(error_mm(arrays, again)) < (3 if smooth else 1)
    if not smooth:
        whole = [np.median(error_mm(arrays, again)[start : start + 32]) for start in range(0, count, 32)]
        assert max(whole) < 1.2 * min(whole), "no group is worse than another"


def test_every_frame_has_its_turn_once_and_with_its_neighbours():
    names = [str(index) for index in range(2 * FRAMES_TOGETHER + 5)]
    for context in (0, 16):
        turns = []
        for window, places in _windows(iter([Frame(name, None) for name in names]), context):
            assert len(window) <= FRAMES_TOGETHER
            for place in places:
                turns.append(window[place].name)
                assert place >= min(context, int(turns[-1])), "neighbours before"
        assert turns == names


@pytest.mark.parametrize(("frames", "padded"), [(1, 64), (64, 64), (100, 128)])
def test_groups_of_frames_are_padded_to_one_length(frames, padded):
    array = np.arange(2.0 * frames).reshape(frames, 2)
    longer = padded_frames(array)
    assert longer.shape == (padded, 2)
    np.testing.assert_array_equal(longer[:frames], array)
    assert np.isnan(longer[frames:]).all()


def test_a_file_without_frames_is_refused(files, take, tmp_path):
    empty = HandBoxes(np.zeros((0, 2, VIEWS, 4)), SIDES, (), np.zeros((0, 2, VIEWS, 21, 2)))
    with pytest.raises(ValueError, match="at least one frame"):
        read_keypoint_take(write_boxes(tmp_path / "empty.npz", empty), files[1])


def test_a_left_model_serves_right_hands():
    hands = hands_of(default_hand("left"))
    assert (hands.right.side, hands.left.side) == ("right", "left")
    np.testing.assert_allclose(hands.right.v_template, default_hand().v_template, atol=1e-7)
