"""Released tars: every set's convention turned into ours once, and every fault by its name."""

import os
import pickle

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.right_hand import as_right_hand
from poem_jax.data.sources.hand_in_views import ManoFile
from poem_jax.data.sources.released_tars import ReleasedTars
from poem_jax.data.tar_labels import CONVENTIONS, convention_of, frame_from_label, label_from_frame
from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import invert_rigid, transform_points
from poem_jax.miniatures.mano_stand_in import stand_in_components, write_mano
from tests.data.one_frame import one_frame
from tests.data.released_labels import JPEG, released_label, tar_sample, write_label
from tests.data.tars import write_tar

WORLD_TO_CAMERA = {"Oakink", "Arctic", "Interhand"}
WITHOUT_MEAN = {"Arctic", "Interhand"}
SETS = [convention.name for convention in CONVENTIONS if convention.name != "Freihand"]


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    return write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl")


@pytest.fixture(scope="module")
def frame():
    return one_frame(skew=0.0)


def label_of(frame, name):
    mean = stand_in_components().mean if name in WITHOUT_MEAN else None
    return released_label(frame, world_to_camera=name in WORLD_TO_CAMERA, mean=mean)


def assert_same_hand(read, frame, mirrored=False):
    for name, atol in {
        "joints_cam": 1e-5,
        "vertices_cam": 1e-5,
        "keypoints_px": 0.01,
        "K": 1e-3,
        "T_cam_from_world": 1e-5,
        "pose_cam": 1e-5,
        "shape": 1e-5,
    }.items():
        np.testing.assert_allclose(getattr(read, name), getattr(frame, name), atol=atol, err_msg=name)
    world = transform_points(invert_rigid(read.T_cam_from_world), read.joints_cam)
    np.testing.assert_allclose(world, world[:1].repeat(len(world), 0), atol=1e-5)
    seen, _ = project(read.K, read.T_cam_from_world, world[0])
    np.testing.assert_allclose(seen, read.keypoints_px, atol=0.01)


@pytest.mark.parametrize("name", SETS)
def test_each_sets_labels_become_the_planted_hand(tmp_path, mano, frame, name):
    write_label(tmp_path / f"{name}_mv_test-000000.tar", label_of(frame, name))
    source = ReleasedTars(tmp_path, mano=mano)
    read = source[0]
    assert (len(source), source.max_views, source.name) == (1, 3, f"{name} tars test")
    assert_same_hand(read, frame)
    assert read.key == f"{name}_mv_test-000000/000001"
    assert read.view_names == frame.view_names
    assert [image.data for image in read.images] == [JPEG + bytes([i]) for i in range(3)]
    assert (read.box_px, read.mirror_px) == (None, None)
    np.testing.assert_array_equal(read.size_wh, frame.size_wh)


def test_freihands_one_camera_is_the_world(tmp_path, mano):
    frame = one_frame(views=1, skew=0.0)
    label = label_of(frame, "Freihand")
    for extrinsics in (label["cam_extr"], None):
        label["cam_extr"] = extrinsics
        write_label(tmp_path / "Freihand_mv_test-000000.tar", label, views=1)
        read = ReleasedTars(tmp_path)[0]
        np.testing.assert_array_equal(read.T_cam_from_world, np.eye(4)[None])
        np.testing.assert_allclose(read.joints_cam, frame.joints_cam, atol=1e-6)
        np.testing.assert_allclose(read.pose_cam, frame.pose_cam, atol=1e-6)


@pytest.mark.parametrize("name", ["DexYCB", "Interhand"])
def test_a_flipped_sample_is_a_mirrored_left_hand_whose_images_are_still_to_be_turned(tmp_path, mano, name):
    left = one_frame(side="left", skew=0.0)
    right = as_right_hand(left)
    label = {**label_of(right, name), "request_flip": True}
    write_label(tmp_path / f"{name}_mv_train-000000.tar", label)
    read = ReleasedTars(tmp_path, mano=mano)[0]
    assert_same_hand(read, right)
    np.testing.assert_allclose(read.mirror_px, right.mirror_px, atol=1e-3)
    # The release's own map between centres of pixels, u' = 2 cx - u with its cx.
    stored = left.keypoints_px[..., 0] - 0.5
    shown = 2 * np.array(label["cam_intr"])[:, None, 0, 2] - stored
    np.testing.assert_allclose(read.keypoints_px[..., 0], shown + 0.5, atol=1e-3)
    assert read.box_px is None


def test_poses_relative_to_the_mean_need_the_mano_file(tmp_path, frame, caplog):
    caplog.set_level("INFO")
    write_label(tmp_path / "Arctic_mv_val_p1-000000.tar", label_of(frame, "Arctic"))
    read = ReleasedTars(tmp_path)[0]
    assert (read.pose_cam, read.shape) == (None, None)
    assert caplog.text.count("poses are left out") == 1
    with pytest.raises(FileNotFoundError, match=r"MANO_RIGHT\.pkl"):
        ReleasedTars(tmp_path, mano=tmp_path / "MANO_RIGHT.pkl")


@pytest.mark.parametrize("change", ["absent", "zeros"])
def test_a_pose_that_is_absent_is_none(tmp_path, frame, change):
    label = label_of(frame, "Oakink")
    if change == "absent":
        del label["mano_pose"], label["mano_shape"]
    else:
        label["mano_pose"] = [np.zeros((16, 3))] * 3
    write_label(tmp_path / "Oakink_mv_test-000000.tar", label)
    read = ReleasedTars(tmp_path)[0]
    assert (read.pose_cam, read.shape) == (None, None)


def test_numbers_behind_the_pose_are_left_out(tmp_path, frame):
    label = label_of(frame, "DexYCB")
    label["mano_pose"] = [np.concatenate([pose, [9.0, 9, 9]])[None] for pose in label["mano_pose"]]
    write_label(tmp_path / "DexYCB_mv_train-000000.tar", label)
    np.testing.assert_allclose(ReleasedTars(tmp_path)[0].pose_cam, frame.pose_cam, atol=1e-6)


def test_a_box_of_its_own_is_kept_at_half_its_scale(tmp_path, frame):
    label = label_of(frame, "HO3D")
    label["bbox_center"] = [np.array([100, 90])] * 3
    label["bbox_scale"] = [160.0] * 3
    write_label(tmp_path / "HO3D_mv_test-000000.tar", label)
    expected = [[60.5, 50.5, 140.5, 130.5]] * 3
    np.testing.assert_allclose(ReleasedTars(tmp_path)[0].box_px, expected)


def _with(name, view, value):
    def change(label):
        label[name] = [np.array(entry, float) for entry in label[name]]
        label[name][view] = value(label[name][view]) if callable(value) else value

    return change


FAULTS = {
    "no joints": (lambda label: label.pop("joints_3d"), "label.pyd lacks `joints_3d`; it has bbox_center"),
    "no extrinsics": (lambda label: label.pop("cam_extr"), "lacks `cam_extr`"),
    "NaN": (_with("joints_3d", 1, lambda x: x * np.nan), "`joints_3d` is not finite in view 1"),
    "3 m wide": (
        _with("verts_3d", 2, lambda x: x.mean(0) + 12 * (x - x.mean(0)) + [0, 0, 5]),
        "`vertices_cam` is a hand of",
    ),
    "not rigid": (_with("cam_extr", 0, lambda T: T * [[1.2], [1], [1], [1]]), "extrinsic is not rigid"),
    "last row": (_with("cam_extr", 0, lambda T: T + np.eye(4)[3][:, None] * 0.5), "extrinsic is not rigid"),
    "a view too few": (lambda label: label["cam_intr"].pop(), "`cam_intr` has 2 entries for 3 images"),
    "another shape": (_with("joints_2d", 0, np.zeros((20, 2))), "`joints_2d` must"),
    "all 20": (
        lambda label: label.update(joints_2d=[np.zeros((20, 2))] * 3),
        r"shape \(21, 2\).*got \(20, 2\)",
    ),
    "text": (lambda label: label.update(bbox_scale=["a", "b", "c"]), "`bbox_scale` must be numbers"),
    "a number": (lambda label: label.update(raw_size=3), "`raw_size` must have one entry a view; got a int"),
    "no box": (lambda label: label.update(bbox_scale=[0.0] * 3), "`bbox_scale` must be positive"),
    "flips": (lambda label: label.update(request_flip=[True] * 3), "`request_flip` must be one truth value"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_label_that_cannot_be_true_is_named(tmp_path, frame, fault):
    change, words = FAULTS[fault]
    label = label_of(frame, "DexYCB")
    change(label)
    shard = write_label(tmp_path / "DexYCB_mv_train-000000.tar", label)
    with pytest.raises(CorruptSampleError, match=words) as caught:
        ReleasedTars(tmp_path)[0]
    assert str(caught.value).startswith(f"{shard}, sample DexYCB_mv_train-000000/000001: ")


class _Hostile:
    def __reduce__(self):
        return os.mkdir, ("hostile",)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (pickle.dumps(_Hostile()), r"label.pyd asks for posix.mkdir"),
        (pickle.dumps({"joints_3d": 1})[:-3], "label.pyd must be a whole pickle"),
        (pickle.dumps([1, 2]), "must hold a dictionary; got a list"),
    ],
)
def test_a_hostile_or_broken_pickle_is_refused_by_name(tmp_path, monkeypatch, data, words):
    monkeypatch.chdir(tmp_path)
    write_label(tmp_path / "HO3D_mv_train-000000.tar", data)
    with pytest.raises(CorruptSampleError, match=words):
        ReleasedTars(tmp_path)[0]
    assert not (tmp_path / "hostile").exists()


def test_missing_and_doubled_images_are_named(tmp_path, frame):
    key, files = tar_sample("7", label_of(frame, "DexYCB"), 3)
    lacking = {name: data for name, data in files.items() if name != "image_1.jpg"}
    write_tar(tmp_path / "DexYCB_mv_test-000000.tar", [(key, lacking), ("8", {**files, "image_1.png": b"x"})])
    source = ReleasedTars(tmp_path)
    with pytest.raises(CorruptSampleError, match=r"numbered 0, 1, 2 \.\.\.; got 0, 2"):
        source[0]
    with pytest.raises(CorruptSampleError, match=r"image_1 is there as image_1\.png and another"):
        source[1]


def test_one_split_is_read_at_a_time_and_names_say_what_it_is(tmp_path, frame):
    for split in ("train_p1", "val_p1"):
        write_label(tmp_path / f"Arctic_mv_{split}-000000.tar", label_of(frame, "Arctic"))
    with pytest.raises(ValueError, match="got 2 among shards of Arctic train_p1, Arctic val_p1: give"):
        ReleasedTars(tmp_path)
    assert ReleasedTars(tmp_path, split="train").name == "Arctic tars train_p1"
    assert ReleasedTars(tmp_path, split="val_p1").name == "Arctic tars val_p1"
    with pytest.raises(ValueError, match="got 0 of split 'test' among"):
        ReleasedTars(tmp_path, split="test")
    write_label(tmp_path / "other" / "Hands_mv_test-000000.tar", label_of(frame, "DexYCB"))
    with pytest.raises(ValueError, match=r"must be named DexYCB_mv_.*got Hands_mv_test"):
        ReleasedTars(tmp_path / "other")
    write_label(tmp_path / "third" / "hands.tar", label_of(frame, "DexYCB"))
    with pytest.raises(ValueError, match=r"must be named SET_mv_SPLIT-NUMBER\.tar"):
        ReleasedTars(tmp_path / "third")


def test_the_released_counts_are_compared_where_all_shards_are_there(tmp_path, frame, caplog):
    caplog.set_level("WARNING", "poem_jax")
    sample = label_of(frame, "DexYCB")
    for number in range(4):
        write_label(tmp_path / f"DexYCB_mv_test-{number:06d}.tar", sample)
    ReleasedTars(f"{tmp_path}/DexYCB_mv_test-{{000000..000002}}.tar", strict_counts=True)
    assert caplog.text == ""
    ReleasedTars(tmp_path)
    assert "has 4 samples in 4 shards; the released tars 4950 (the paper: 4951)" in caplog.text
    with pytest.raises(ValueError, match="the released tars 4950"):
        ReleasedTars(tmp_path, strict_counts=True)


def test_faults_of_shards_are_kept_and_logged(tmp_path, frame, caplog):
    good = tar_sample("000001", label_of(frame, "DexYCB"), 3)
    write_tar(tmp_path / "DexYCB_mv_test-000000.tar", [good, ("000002", {"image_0.jpg": JPEG})])
    source = pickle.loads(pickle.dumps(ReleasedTars(tmp_path)))
    assert [(f.key, f.problem) for f in source.faults] == [("000002", "it has no label.pyd")]
    assert "sample 000002: it has no label.pyd" in caplog.text
    assert len(source) == 1
    assert source[0].key.endswith("000001")


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("side", ["right", "left"])
def test_what_is_packed_is_what_is_read(mano, name, side):
    frame = one_frame(side=side, skew=0.0)
    frame = as_right_hand(frame) if side == "left" else frame
    frame = frame._replace(box_px=np.tile([60.5, 50.5, 140.5, 130.5], (3, 1))) if side == "left" else frame
    hand = ManoFile.open(mano)
    convention = convention_of(f"{name}_mv_")
    label = label_from_frame(frame, convention, index=3, mano=hand)
    again = pickle.loads(pickle.dumps(label))
    read = frame_from_label(again, frame.images, convention, path="a.tar", key=frame.key, mano=hand)
    assert_same_hand(read, frame)
    for field in ("box_px", "mirror_px"):
        value = getattr(frame, field)
        got = getattr(read, field)
        assert (value is None) == (got is None)
        if value is not None:
            np.testing.assert_allclose(got, value, atol=1e-3)
