"""HO-3D: cameras, axes and held-out views of a planted hand; both readings of `cam_orders.txt`."""

import json
import logging
import pickle
import shutil

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources import ho3d_calibration
from poem_jax.data.sources.ho3d import HO3D
from poem_jax.miniatures.mano_stand_in import write_mano
from tests.data.sources.raw_trees import (
    write_ho3d,
    write_ho3d_archive,
    write_ho3d_official,
    write_pickle,
)
from tests.data.sources.test_dexycb import assert_is_planted

ORDER = [2, 0, 1, 3, 4]


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    return write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(ho3d_calibration, "_warned", set())


@pytest.mark.parametrize("authors", [False, True])
def test_the_reading_of_cam_orders_is_the_one_under_which_hands_meet(tmp_path, mano, caplog, authors):
    planted = write_ho3d(tmp_path / "HO3D_v3", authors=authors)
    with caplog.at_level(logging.WARNING):
        frame = pickle.loads(pickle.dumps(HO3D(tmp_path, mano=mano)))[0]
    assert (frame.key, frame.view_names, frame.box_px) == ("ABF1/0007", tuple("20134"), None)
    assert_is_planted(frame, planted, ORDER)
    assert any("cam_orders" in message for message in caplog.messages) == authors


def test_hands_that_do_not_meet_are_refused(tmp_path, mano):
    write_ho3d(tmp_path)
    path = tmp_path / "calibration" / "ABF1" / "calibration" / "trans_0.txt"
    path.write_text(path.read_text().replace("e-01", "e-02"))
    with pytest.raises(CorruptSampleError, match=r"ABF1/0007.* apart in the world"):
        HO3D(tmp_path, mano=mano)[0]


def test_without_calibration_v2_takes_the_cameras_from_the_labels(tmp_path, mano):
    planted = write_ho3d(tmp_path / "HO3D_v2", calibration=False)
    assert_is_planted(HO3D(tmp_path, mano=mano, version="v2")[0], planted, ORDER)
    with pytest.raises(FileNotFoundError, match=r"calibration of ABF1"):
        HO3D(tmp_path / "HO3D_v2", mano=mano, version="v3")


def test_held_out_views_get_labels_of_the_archive_and_the_boxes_of_the_set(tmp_path, mano):
    planted = write_ho3d(tmp_path / "HO3D_v3")
    with pytest.raises(FileNotFoundError, match="HO3D_v3_manual_test_gt"):
        HO3D(tmp_path, mano=mano, split="test")
    write_ho3d_archive(tmp_path / "HO3D_v3_manual_test_gt", planted)
    frame = HO3D(tmp_path, mano=mano, split="test")[0]
    assert_is_planted(frame, planted, ORDER)
    assert frame.box_px is not None
    np.testing.assert_array_equal(frame.box_px[2], [100.5, 80.5, 200.5, 160.5])
    around = np.concatenate([frame.keypoints_px.min(1), frame.keypoints_px.max(1)], -1)
    np.testing.assert_array_equal(frame.box_px[[0, 1, 4]], around[[0, 1, 4]])


def test_held_out_views_of_v2_are_left_out_with_a_warning(tmp_path, mano, caplog):
    planted = write_ho3d(tmp_path / "HO3D_v2", calibration=False)
    with caplog.at_level(logging.WARNING):
        source = HO3D(tmp_path, mano=mano, split="test", version="v2")
    assert any("2 views are left out" in message for message in caplog.messages)
    assert_is_planted(source[0], planted, [2, 0, 4])
    write_ho3d_official(tmp_path / "HO3D_v2_official_gt", planted)
    frame = HO3D(tmp_path, mano=mano, split="test", version="v2")[0]
    assert frame.pose_cam is None
    assert_is_planted(frame, planted, ORDER, pose=False)


def test_the_official_evaluation_set_is_single_views(tmp_path, mano):
    planted = write_ho3d(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"evaluation_xyz\.json and evaluation_verts\.json"):
        HO3D(tmp_path, mano=mano, split="evaluation")
    write_ho3d_official(tmp_path / "gt", planted)
    source = HO3D(tmp_path, mano=mano, split="evaluation", held_out=tmp_path / "gt")
    assert (len(source), source.max_views) == (2, 1)
    for i, camera in enumerate((1, 3)):
        assert source[i].key == f"SB1{camera}/0043"
        assert_is_planted(source[i], planted, [camera], pose=False)


def test_the_official_evaluation_set_has_multi_view_frames_too(tmp_path, mano):
    planted = write_ho3d(tmp_path / "HO3D_v3")
    write_ho3d_official(tmp_path / "HO3D_v3", planted)
    source = HO3D(tmp_path, mano=mano, split="evaluation-mv")
    assert (len(source), source.max_views) == (1, 5)
    frame = source[0]
    assert (frame.key, frame.view_names) == ("SB1/0043", ("1", "3"))
    assert_is_planted(frame, planted, [1, 3], pose=False)
    np.testing.assert_array_equal(frame.box_px, [[100.5, 80.5, 200.5, 160.5]] * 2)
    with pytest.raises(ValueError, match="2 frames, and the set's own count is 20137"):
        HO3D(tmp_path, mano=mano, split="evaluation-mv", strict_counts=True)


@pytest.mark.parametrize("split", ["evaluation", "evaluation-mv"])
def test_a_recording_of_one_camera_is_the_world_and_has_no_digit(tmp_path, mano, split):
    root = tmp_path / "HO3D_v3"
    planted = write_ho3d(root)
    write_ho3d_official(root, planted)
    shutil.copytree(root / "evaluation" / "SB13", root / "evaluation" / "SM1")
    with (root / "evaluation.txt").open("a") as stream:
        stream.write("\nSM1/0043")
    for path in root.glob("evaluation_*.json"):
        rows = json.loads(path.read_text())
        path.write_text(json.dumps([*rows, rows[1]]))
    source = HO3D(tmp_path, mano=mano, split=split)
    frame = source[len(source) - 1]
    assert (frame.key, frame.view_names) == ("SM1/0043", ("SM1",))
    np.testing.assert_array_equal(frame.T_cam_from_world, np.eye(4)[None])
    assert_is_planted(frame, planted, [3], pose=False)


@pytest.mark.parametrize("split", ["test", "evaluation-mv"])
def test_v2_takes_the_calibration_of_v3_beside_it(tmp_path, mano, caplog, split):
    root = tmp_path / "HO3D_v2"
    planted = write_ho3d(root, calibration=False)
    write_ho3d_official(root, planted)
    views = ORDER if split == "test" else [1, 3]
    with caplog.at_level(logging.WARNING):
        alone = HO3D(tmp_path, mano=mano, split=split, version="v2")[0]
    assert any("extrinsics of SB1 are made from the labels" in message for message in caplog.messages)
    np.testing.assert_array_equal(alone.T_cam_from_world[0], np.eye(4))
    caplog.clear()
    write_ho3d(tmp_path / "HO3D_v3", authors=False)
    beside = HO3D(tmp_path, mano=mano, split=split, version="v2")[0]
    assert not any("made from the labels" in message for message in caplog.messages)
    np.testing.assert_allclose(beside.T_cam_from_world, planted.T_cam_from_world[views], atol=1e-6)


def test_labels_of_another_image_are_refused(tmp_path, mano):
    planted = write_ho3d(tmp_path)
    write_ho3d_official(tmp_path, planted._replace(joints_cam=planted.joints_cam[::-1]))
    with pytest.raises(CorruptSampleError, match="of another image"):
        HO3D(tmp_path, mano=mano, split="evaluation")[0]


def test_frames_without_the_master_are_counted(tmp_path, mano, caplog):
    write_ho3d(tmp_path, cameras=(0, 1, 3, 4))
    with caplog.at_level(logging.WARNING):
        assert len(HO3D(tmp_path, mano=mano)) == 0
    assert any("1 frames are left out" in message for message in caplog.messages)


class Hostile:
    def __reduce__(self):
        return eval, ("1 + 1",)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (Hostile(), "eval"),
        ({"camMat": np.eye(3)}, "`handJoints3D` is missing"),
        ([1], "must hold a dictionary"),
        ({"camMat": np.eye(2)}, r"`camMat` must have shape \(3, 3\)"),
    ],
)
def test_damaged_labels_are_named(tmp_path, mano, content, problem):
    write_ho3d(tmp_path)
    write_pickle(tmp_path / "train" / "ABF10" / "meta" / "0007.pkl", content)
    with pytest.raises(CorruptSampleError, match=rf"ABF10/meta/0007\.pkl, sample ABF1/0007.*{problem}"):
        HO3D(tmp_path, mano=mano)[0]


def test_missing_and_damaged_lists_are_named(tmp_path, mano):
    write_ho3d(tmp_path)
    (tmp_path / "evaluation.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"evaluation\.txt.*shreyashampali"):
        HO3D(tmp_path, mano=mano, split="test")
    (tmp_path / "train.txt").write_text("ABF10/0007\n../../secret/0001\n")
    with pytest.raises(ValueError, match="line 2"):
        HO3D(tmp_path, mano=mano)
    (tmp_path / "train.txt").write_bytes(b"ABF10/0007\xff")
    with pytest.raises(ValueError, match=r"train\.txt must have .* no text"):
        HO3D(tmp_path, mano=mano)
    with pytest.raises(FileNotFoundError, match=r"train\.txt"):
        HO3D(tmp_path / "train", mano=mano)
