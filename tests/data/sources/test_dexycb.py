"""DexYCB: the planted hand comes back, splits, views that are dropped, and faults by their names."""

import logging
import pickle

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources import dexycb_files
from poem_jax.data.sources.dexycb import MASTER, DexYCB
from poem_jax.data.sources.dexycb_files import is_in_split
from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand, write_mano
from tests.data.sources.raw_trees import SERIALS, write_dexycb

MASTER_FIRST = [2, 0, 1, 3, 4, 5, 6, 7]


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    return write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def assert_is_planted(read, planted, views, *, pose=True):
    planted = planted._replace(
        **{n: v[views] for n, v in planted._asdict().items() if isinstance(v, np.ndarray)}
    )
    for name, atol in {"joints_cam": 1e-5, "vertices_cam": 1e-5, "keypoints_px": 0.01, "K": 1e-3}.items():
        np.testing.assert_allclose(getattr(read, name), getattr(planted, name), atol=atol, err_msg=name)
    relative = [T @ np.linalg.inv(T[0]) for T in (read.T_cam_from_world, planted.T_cam_from_world)]
    np.testing.assert_allclose(*relative, atol=1e-5)
    if pose:
        turns = [rotation_from_axis_angle(np.asarray(p, float)) for p in (read.pose_cam, planted.pose_cam)]
        np.testing.assert_allclose(*turns, atol=1e-5)
        np.testing.assert_allclose(read.shape, planted.shape, atol=1e-5)


def test_the_planted_hand_comes_back_with_the_constant_master_first(tmp_path, mano):
    planted = write_dexycb(tmp_path / "DexYCB", sequences=1)
    source = DexYCB(tmp_path, mano=mano)
    assert len(source) == 1
    frame = pickle.loads(pickle.dumps(source))[0]
    assert frame.key == "20200709-subject-01/20200709_140000/000000"
    assert frame.view_names == tuple(SERIALS[v] for v in MASTER_FIRST)
    assert frame.view_names[0] == MASTER
    assert_is_planted(frame, planted, MASTER_FIRST)


def test_views_without_a_hand_are_dropped_and_frames_without_the_master_counted(tmp_path, mano, caplog):
    write_dexycb(tmp_path, sequences=1, frames=3, absent={(0, 0), (7, 1), (2, 2)})
    with caplog.at_level(logging.WARNING):
        source = DexYCB(tmp_path, mano=mano)
    # Frame 1 is seen by the first camera, frame 0 only by later ones.
    assert [source[i].key[-6:] for i in range(len(source))] == ["000001", "000000"]
    assert SERIALS[7] not in source[0].view_names
    assert len(source[1].images) == 7
    assert any("1 frames are left out" in message and MASTER in message for message in caplog.messages)


def test_the_list_is_read_from_the_labels_once(tmp_path, mano):
    write_dexycb(tmp_path, sequences=1, frames=2, absent={(4, 1)})
    first = DexYCB(tmp_path, mano=mano)
    for path in tmp_path.rglob("labels_*.npz"):
        path.write_bytes(b"")
    second = DexYCB(tmp_path, mano=mano)
    assert first.fingerprint() == second.fingerprint()
    with pytest.raises(CorruptSampleError, match=r"labels_000000\.npz.*20200709_140000/000000"):
        second[0]


def test_a_list_of_labels_that_could_not_be_read_is_not_kept(tmp_path, mano, caplog):
    write_dexycb(tmp_path, sequences=1, frames=2, absent={(4, 1)})
    path = next(tmp_path.rglob(f"{SERIALS[4]}/labels_000001.npz"))
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    with caplog.at_level(logging.WARNING):
        damaged = DexYCB(tmp_path, mano=mano)
    assert any("1 labels cannot be read" in message for message in caplog.messages)
    with pytest.raises(CorruptSampleError, match=rf"{SERIALS[4]}/labels_000001\.npz"):
        damaged[1]
    path.write_bytes(whole)
    assert SERIALS[4] not in DexYCB(tmp_path, mano=mano)[1].view_names


@pytest.mark.parametrize(
    ("setup", "counts"),
    [("s0", (800, 40, 160)), ("s1", (700, 100, 200)), ("s3", (750, 100, 150))],
)
def test_every_sequence_is_in_one_split(setup, counts):
    splits = ("train", "val", "test")
    of = np.array([[[is_in_split(setup, s, j, i) for s in splits] for i in range(100)] for j in range(10)])
    assert (of.sum(-1) == 1).all()
    assert tuple(of.sum((0, 1))) == counts


def test_left_hands_are_dropped_or_mirrored(tmp_path, mano):
    write_dexycb(tmp_path, sequences=1, side="left")
    assert len(DexYCB(tmp_path, mano=mano)) == 0
    with pytest.raises(ValueError, match="MANO_LEFT"):
        DexYCB(tmp_path, mano=mano, left=True)
    with pytest.raises(ValueError, match="must be a left hand"):
        DexYCB(tmp_path, mano=mano, left=True, mano_left=mano)


@pytest.mark.parametrize("faulty", [False, True])
def test_a_left_hand_has_a_shape_unless_its_labels_need_the_faulty_directions(tmp_path, mano, faulty):
    planted = write_dexycb(tmp_path, sequences=1, side="left")
    left = write_mano(tmp_path / "MANO_LEFT.pkl", side="left")
    hand = stand_in_hand("left")
    if faulty:
        hand = hand._replace(shapedirs=hand.shapedirs * np.array([-1, 1, 1], np.float32)[:, None])
    source = DexYCB(tmp_path, mano=mano, left=True, mano_left=left)
    betas = source._sequences[0].betas
    resting_wrist = hand_mesh(hand, np.zeros((16, 3), np.float32), betas).joints[0]
    for path in tmp_path.rglob("labels_*.npz"):
        arrays, view = dict(np.load(path)), SERIALS.index(path.parent.name)
        pose_m = arrays["pose_m"]
        pose_m[0, 48:] = planted.joints_cam[view, 0] - resting_wrist
        pose = stand_in_components("left").pose(pose_m[:, :3], pose_m[:, 3:48])
        joints = hand_mesh(hand, pose[0], betas, pose_m[0, 48:]).joints
        pixels = project_cam(source._K[view], joints)
        changed = {"joint_3d": joints[None], "joint_2d": pixels[None] - 0.5, "pose_m": pose_m}
        np.savez(path, **{**arrays, **{name: value.astype(np.float32) for name, value in changed.items()}})
    frame = source[0]
    assert frame.mirror_px is not None
    assert frame.pose_cam is not None
    assert (frame.shape is None) == faulty


@pytest.mark.parametrize(("setup", "split"), [("s2", "train"), ("s0", "evaluation")])
def test_other_setups_and_splits_are_refused(tmp_path, mano, setup, split):
    with pytest.raises(ValueError, match=setup if split == "train" else split):
        DexYCB(tmp_path, mano=mano, setup=setup, split=split)


def test_what_is_missing_is_named_with_where_to_get_it(tmp_path, mano):
    with pytest.raises(FileNotFoundError, match=r"calibration.*dex-ycb\.github\.io"):
        DexYCB(tmp_path, mano=mano)
    write_dexycb(tmp_path, sequences=1)
    with pytest.raises(FileNotFoundError, match="MANO_RIGHT"):
        DexYCB(tmp_path, mano=tmp_path / "none.pkl")
    with pytest.raises(FileNotFoundError, match="no sequence of s0 val"):
        DexYCB(tmp_path, mano=mano, split="val")
    (tmp_path / "calibration" / "intrinsics" / f"{MASTER}_640x480.yml").unlink()
    with pytest.raises(FileNotFoundError, match=f"{MASTER}_640x480"):
        DexYCB(tmp_path, mano=mano)


def test_counts_of_the_paper_are_compared(tmp_path, mano, monkeypatch):
    write_dexycb(tmp_path, sequences=1, frames=2, absent={(2, 1)})
    with pytest.raises(ValueError, match=r"subject-01 has 1 sequences of 100.*dex-ycb\.github\.io"):
        DexYCB(tmp_path, mano=mano, strict_counts=True)
    monkeypatch.setattr(dexycb_files, "SEQUENCES_PER_SUBJECT", 1)
    # Frames that the master does not show are in the paper's number.
    with pytest.raises(ValueError, match="has 2 frames, and the paper counts 25387"):
        DexYCB(tmp_path, mano=mano, strict_counts=True)


def test_labels_of_another_hand_are_refused(tmp_path, mano):
    write_dexycb(tmp_path, sequences=1)
    source = DexYCB(tmp_path, mano=mano)
    path = next(tmp_path.rglob(f"{MASTER}/labels_000000.npz"))
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "pose_m": arrays["pose_m"] + np.eye(51)[50] * 0.1})
    with pytest.raises(CorruptSampleError, match=rf"{MASTER}/labels_000000\.npz.*0\.1 m from the labelled"):
        source[0]
