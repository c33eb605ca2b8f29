"""One's own captures: labels of `poem fit`'s kind and MANO's, lenses, left hands, and what is left out."""

import pickle

import cv2
import numpy as np
import pytest

from poem_jax.calibration.rig_json import write_rig
from poem_jax.data.frames import CorruptSampleError, check_frame
from poem_jax.data.lens import project_raw
from poem_jax.data.sources.captures import Captures
from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import invert_rigid, transform_points
from poem_jax.hand.model import hand_mesh, mirror
from poem_jax.hand.template import default_hand
from poem_jax.io.npz_rows import NpzRows
from tests.rigs import small_rig

NAMES = ("0000", "0003", "0006")


def hands(sides=("right", "left"), frames=3):
    """Pose, shape and place of a hand of each side in each frame, and their meshes."""
    rng = np.random.default_rng(3)
    shape = (frames, len(sides))
    given = {
        "pose": 0.2 * rng.normal(size=(*shape, 16, 3)).astype(np.float32),
        "shape": rng.normal(size=(*shape, 10)).astype(np.float32),
        "translation": rng.uniform(-0.03, 0.03, (*shape, 3)).astype(np.float32),
    }
    models = {"right": default_hand(), "left": mirror(default_hand())}
    meshes = [
        hand_mesh(models[side], *(given[name][:, i] for name in ("pose", "shape", "translation")))
        for i, side in enumerate(sides)
    ]
    return given, np.stack([m.joints for m in meshes], 1), np.stack([m.vertices for m in meshes], 1)


def write_capture(folder, rig=None, **changes):
    """A take of three frames with both hands; returns its labels."""
    rig = small_rig() if rig is None else rig
    given, joints, vertices = hands()
    for name in NAMES:
        (folder / "frames" / name).mkdir(parents=True)
        for camera in rig.names:
            image = np.full((180, 240, 3), 90, np.uint8)
            assert cv2.imwrite(str(folder / "frames" / name / f"{camera}.png"), image)
    write_rig(folder / "rig.json", rig)
    labels = {
        "hand_side": np.array(["right", "left"]),
        "frames": np.array(["0", "3", "6"]),
        "cameras": np.array(rig.names),
        "joints_world": joints,
        "vertices_world": vertices,
        "valid": np.ones((3, 2), bool),
        "reprojection_px": np.full((3, 2, 3), 2.0),
        **given,
        **changes,
    }
    np.savez(folder / "labels.npz", **{name: value for name, value in labels.items() if value is not None})
    return labels


def test_every_hand_of_every_frame_is_a_sample_in_each_cameras_frame(tmp_path):
    labels = write_capture(tmp_path / "desk")
    source = pickle.loads(pickle.dumps(Captures(tmp_path / "desk")))
    assert (len(source), source.max_views) == (6, 3)
    frame = source[2]
    assert frame.key == "desk/3/right"
    assert frame.view_names == small_rig().names
    for view, T in enumerate(frame.T_cam_from_world):
        world = transform_points(invert_rigid(T), frame.vertices_cam[view].astype(np.float64))
        assert np.allclose(world, labels["vertices_world"][1, 0], atol=1e-6)
        posed = hand_mesh(default_hand(), frame.pose_cam[view], frame.shape[view])
        assert np.allclose(
            posed.joints - posed.joints[0], frame.joints_cam[view] - frame.joints_cam[view, 0], atol=1e-6
        )


def test_key_points_are_ideal_and_the_lens_takes_them_to_the_photograph(tmp_path):
    labels = write_capture(tmp_path / "desk")
    rig, frame = small_rig(), Captures(tmp_path / "desk")[0]
    assert np.allclose(frame.dist, rig.dist)
    for view in range(3):
        points = labels["joints_world"][0, 0].astype(np.float64)
        K_index = frame.K[view] - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        T = frame.T_cam_from_world[view]
        raw, _ = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K_index, frame.dist[view])
        skew = K_index[0, 1] * (raw[:, 0, 1] - K_index[1, 2]) / K_index[1, 1]
        raw = raw[:, 0] + 0.5 + np.stack([skew, 0 * skew], -1)
        assert np.allclose(raw, project_raw(rig, view, points)[0], atol=0.01)
        assert np.allclose(
            frame.keypoints_px[view], project_cam(rig.K[view], frame.joints_cam[view]), atol=0.01
        )


def test_a_left_hand_comes_as_the_right_hand_of_a_mirror(tmp_path):
    labels = write_capture(tmp_path / "desk")
    frame = Captures(tmp_path / "desk")[1]
    assert frame.key == "desk/0/left"
    rig = small_rig()
    stored = transform_points(rig.T_cam_from_world[0], labels["vertices_world"][0, 1].astype(np.float64))
    assert np.allclose(frame.vertices_cam[0], stored * [-1, 1, 1], atol=1e-6)
    assert np.allclose(frame.mirror_px, rig.K[:, 0, 2])
    posed = hand_mesh(default_hand(), frame.pose_cam[0], frame.shape[0])
    assert np.allclose(
        posed.vertices - posed.joints[0], frame.vertices_cam[0] - frame.joints_cam[0, 0], atol=1e-5
    )


def test_labels_of_mano_alone_give_the_same_hands(tmp_path):
    write_capture(tmp_path / "mesh")
    write_capture(tmp_path / "mano", vertices_world=None, joints_world=None)
    hand = default_hand()._asdict()
    np.savez(
        tmp_path / "MANO_RIGHT.npz", f=hand.pop("faces"), **{k: v for k, v in hand.items() if k != "is_left"}
    )
    with pytest.raises(ValueError, match="say which MANO file"):
        Captures(tmp_path / "mano")
    made = Captures(tmp_path / "mano", mano=tmp_path / "MANO_RIGHT.npz")
    for ours, theirs in zip(made, Captures(tmp_path / "mesh"), strict=True):
        assert np.allclose(ours.vertices_cam, theirs.vertices_cam, atol=1e-6)
        assert np.allclose(ours.joints_cam, theirs.joints_cam, atol=1e-6)


def test_joints_alone_are_labels_for_those_who_ask_for_them(tmp_path):
    labels = write_capture(tmp_path / "desk", vertices_world=None, pose=None)
    with pytest.raises(ValueError, match="must hold joints_world and vertices_world"):
        Captures(tmp_path / "desk")
    source = Captures(tmp_path / "desk", joints_alone=True)
    for index, frame in enumerate(map(source.__getitem__, range(len(source)))):
        T_world_from_cam = invert_rigid(frame.T_cam_from_world[0])
        world = transform_points(T_world_from_cam, frame.joints_cam[0].astype(np.float64))
        if frame.mirror_px is None:
            assert np.allclose(world, labels["joints_world"][index // 2, index % 2], atol=1e-6)
        assert np.isnan(frame.vertices_cam).all()
        with pytest.raises(CorruptSampleError, match="`vertices_cam` is not finite"):
            check_frame(frame, "x")


def test_joints_alone_are_not_taken_where_there_is_a_mesh(tmp_path):
    write_capture(tmp_path / "desk")
    assert np.isfinite(Captures(tmp_path / "desk", joints_alone=True)[0].vertices_cam).all()


def test_what_no_camera_shows_is_left_out(tmp_path):
    _, joints, _ = hands()
    rig = small_rig()
    away = np.float32([0, 0, 40])
    valid = np.ones((3, 2), bool)
    valid[2, 1] = False
    folder = tmp_path / "desk"
    write_capture(folder, joints_world=joints + away * [[[[0]]], [[[1]]], [[[0]]]], valid=valid)
    (folder / "frames" / "0006" / f"{rig.names[1]}.png").unlink()
    source = Captures(folder)
    assert [frame.key for frame in source] == ["desk/0/right", "desk/0/left", "desk/6/right"]
    assert source[2].view_names == (rig.names[0], rig.names[2])


def test_views_in_which_the_fit_is_far_off_can_be_left_out(tmp_path):
    errors = np.full((3, 2, 3), 2.0)
    errors[:, :, 1] = 30
    errors[0, 0, 0] = np.nan
    write_capture(tmp_path / "desk", reprojection_px=errors)
    source = Captures(tmp_path / "desk", max_reprojection_px=10.0)
    names = small_rig().names
    assert source[0].view_names == (names[2],)
    assert source[1].view_names == (names[0], names[2])


def test_two_folders_of_one_name_keep_their_keys_apart(tmp_path):
    for place in ("a", "b"):
        write_capture(tmp_path / place / "desk")
    source = Captures([tmp_path / "a" / "desk", tmp_path / "b" / "desk"])
    assert len({frame.key for frame in source}) == len(source) == 12
    with pytest.raises(ValueError, match="given twice"):
        Captures([tmp_path / "a" / "desk"] * 2)


def test_the_fingerprint_tells_other_labels(tmp_path):
    write_capture(tmp_path / "desk")
    before = Captures(tmp_path / "desk").fingerprint()
    assert before == Captures(tmp_path / "desk").fingerprint()
    _, joints, vertices = hands()
    (tmp_path / "desk" / "labels.npz").unlink()
    np.savez(
        tmp_path / "desk" / "labels.npz",
        hand_side=["right", "left"],
        frames=NAMES,
        joints_world=joints + 0.001,
        vertices_world=vertices + 0.001,
    )
    after = Captures(tmp_path / "desk").fingerprint()
    assert {name for name in before if before[name] != after[name]} >= {"desk labels"}
    assert before["desk rig"] == after["desk rig"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hand_side": np.array(["right", "up"])}, "must hold 'left' or 'right'"),
        (
            {"vertices_world": np.zeros((3, 2, 700, 3))},
            r"`vertices_world` must have shape .* \(3, 2, 778, 3\)",
        ),
        ({"vertices_world": None, "translation": None}, "missing: translation"),
        ({"frames": None}, "add `frames"),
        ({"cameras": np.array(["x", "y", "z"])}, "belong to the world of their own rig"),
        ({"frames": np.array(["10", "11", "12"])}, "no usable sample"),
    ],
)
def test_wrong_labels_are_refused(tmp_path, changes, message):
    write_capture(tmp_path / "desk", **changes)
    with pytest.raises(ValueError, match=message):
        Captures(tmp_path / "desk")


def test_missing_labels_say_how_to_make_them(tmp_path):
    write_capture(tmp_path / "desk")
    (tmp_path / "desk" / "labels.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"poem fit .*desk"):
        Captures(tmp_path / "desk")


def test_labels_and_images_that_go_while_in_use_are_corrupt_samples(tmp_path):
    folder = tmp_path / "desk"
    write_capture(folder)
    source = Captures(folder)
    (folder / "frames" / "0000" / "front.png").unlink()
    with pytest.raises(CorruptSampleError, match=r"desk/0/right.*cannot be read"):
        source[0]
    (folder / "labels.npz").write_bytes(b"other")
    with pytest.raises(CorruptSampleError, match="has changed"):
        source[2]


def test_a_hand_of_three_metres_is_a_corrupt_sample(tmp_path):
    _, _, vertices = hands()
    write_capture(tmp_path / "desk", vertices_world=vertices * 20)
    with pytest.raises(CorruptSampleError, match="vertices_cam` is a hand of"):
        Captures(tmp_path / "desk")[0]


@pytest.mark.parametrize(
    ("dist", "message"),
    [
        (np.zeros((3, 4)), "`dist` must have a row of 5, 8, 12, 14, 15 terms for each of 3 images"),
        (np.full((3, 5), np.nan), "`dist` is not finite in"),
    ],
)
def test_a_lens_of_wrong_shape_or_value_is_refused(tmp_path, dist, message):
    write_capture(tmp_path / "desk")
    frame = Captures(tmp_path / "desk")[0]
    with pytest.raises(CorruptSampleError, match=message):
        check_frame(frame._replace(dist=dist), "labels.npz")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_rows_of_an_npz_are_those_of_its_array(tmp_path, save):
    array = np.random.default_rng(0).normal(size=(5, 2, 3)).astype(np.float32)
    save(tmp_path / "a.npz", other=np.arange(7), rows=array, ordered=np.asfortranarray(array))
    for name in ("rows", "ordered"):
        rows = pickle.loads(pickle.dumps(NpzRows(tmp_path / "a.npz", name)))
        assert len(rows) == 5
        assert np.array_equal(np.stack([rows[i] for i in range(5)]), array)
    with pytest.raises(IndexError):
        rows[5]
