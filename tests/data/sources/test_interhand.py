import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources.interhand import OPENPOSE_FROM_INTERHAND, InterHand
from poem_jax.miniatures import interhand
from poem_jax.miniatures.mano_stand_in import write_mano
from poem_jax.miniatures.scene import PlantedFrame
from tests.data.sources.planted import assert_planted

_SPLITS = ("train", "val", "test")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def mano(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[PlantedFrame]]:
    root = tmp_path_factory.mktemp("interhand")
    return root, interhand.write(root, frames=1)


@pytest.fixture
def root(written: tuple[Path, list[PlantedFrame]], tmp_path: Path) -> Path:
    """A copy whose annotations may be changed."""
    folder = tmp_path / "InterHand2.6M"
    shutil.copytree(written[0] / "annotations", folder / "annotations")
    (folder / "images").symlink_to(written[0] / "images")
    return folder


def _edit(root: Path, split: str, part: str, change) -> None:
    path = root / "annotations" / split / f"InterHand2.6M_{split}_{part}.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_every_planted_hand_is_found(written: tuple[Path, list[PlantedFrame]], mano: Path):
    root, planted = written
    frames = [frame for split in _SPLITS for frame in InterHand(root, split=split, mano=mano)]
    assert len(frames) == len(planted)
    for expected in planted:
        (frame,) = [frame for frame in frames if frame.key == f"Capture{expected.key_hint}"]
        assert len(set(frame.view_names)) == 8
        assert_planted(frame, expected)


def test_the_draw_depends_on_seed_capture_and_frame_alone(
    written: tuple[Path, list[PlantedFrame]], mano: Path
):
    draws = [InterHand(written[0], mano=mano, seed=seed)[0].view_names for seed in (0, 0, 1, 2)]
    assert draws[0] == draws[1]
    assert len({draws[0], draws[2], draws[3]}) == 3


def test_draws_of_a_frame_share_no_camera(written: tuple[Path, list[PlantedFrame]], mano: Path):
    source = InterHand(written[0], mano=mano, views=4, draws=3)
    cameras = len(written[1][0].view_names)
    assert len(source) == cameras // 4
    names = [name for frame in source for name in frame.view_names]
    assert len(set(names)) == len(names) == 4 * len(source)
    assert len({frame.key for frame in source}) == len(source)
    assert len(InterHand(written[0], mano=mano, views=100)[0].images) == cameras


def test_frames_of_other_hands_and_with_lost_joints_do_not_count(root: Path, mano: Path):
    assert len(InterHand(root, split="val", mano=mano)) == 1

    def lose_a_joint(content: dict) -> None:
        for frames in content.values():
            for entry in frames.values():
                entry["joint_valid"][3] = [0]

    _edit(root, "val", "joint_3d", lose_a_joint)
    with pytest.raises(ValueError, match="no frame of a right hand alone"):
        InterHand(root, split="val", mano=mano)


def test_changed_annotations_are_read_anew(root: Path, mano: Path):
    before = InterHand(root, split="val", mano=mano)[0]

    def move(content: dict) -> None:
        for frames in content.values():
            for entry in frames.values():
                entry["world_coord"] = [[x + 7.0, y, z] for x, y, z in entry["world_coord"]]

    _edit(root, "val", "joint_3d", move)
    after = InterHand(root, split="val", mano=mano)[0]
    moved = np.linalg.norm(after.joints_cam - before.joints_cam, axis=-1)
    np.testing.assert_allclose(moved, 7e-3, atol=1e-6)


def test_a_fit_of_another_hand_is_refused(root: Path, mano: Path):
    def turn(content: dict) -> None:
        for frames in content.values():
            for fits in frames.values():
                fits["right"]["pose"][:3] = [-x for x in fits["right"]["pose"][:3]]

    _edit(root, "val", "MANO_NeuralAnnot", turn)
    with pytest.raises(CorruptSampleError, match=r"MANO_NeuralAnnot\.json, sample Capture.*at most 0\.05"):
        InterHand(root, split="val", mano=mano)[0]


def test_joints_are_gathered_as_the_set_lists_them():
    expected = [20, 3, 2, 1, 0, 7, 6, 5, 4, 11, 10, 9, 8, 15, 14, 13, 12, 19, 18, 17, 16]
    assert list(OPENPOSE_FROM_INTERHAND) == expected


def test_what_is_missing_or_wrong_is_named(root: Path, mano: Path, tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"annotations/train.*mks0601"):
        InterHand(tmp_path / "nowhere", mano=mano)
    with pytest.raises(ValueError, match="`views` and `draws` must be positive"):
        InterHand(root, mano=mano, views=0)

    def replace_a_focal_length(value: object) -> None:
        def change(content: dict) -> None:
            for rig in content.values():
                rig["focal"][next(iter(rig["focal"]))] = value

        _edit(root, "val", "camera", change)

    for value, problem in (
        (["wide", 1], "must be numbers"),
        ([[1], 2], "must be numbers"),
        ([1], r"must have shape \(2,\)"),
    ):
        replace_a_focal_length(value)
        with pytest.raises(ValueError, match=rf"val_camera\.json, capture .*`focal` of camera .*{problem}"):
            InterHand(root, split="val", mano=mano)
    replace_a_focal_length([1200, 1200])
    _edit(root, "val", "camera", lambda content: [rig["campos"].clear() for rig in content.values()])
    with pytest.raises(CorruptSampleError, match=r"val_camera\.json, sample Capture.*must have cameras"):
        InterHand(root, split="val", mano=mano)[0]

    def shorten(content: dict) -> None:
        for frames in content.values():
            for fits in frames.values():
                if fits.get("right") is not None:
                    fits["right"]["pose"].pop()

    _edit(root, "test", "MANO_NeuralAnnot", shorten)
    with pytest.raises(ValueError, match=r"test_MANO_NeuralAnnot\.json, capture .*`pose` must have 48"):
        InterHand(root, split="test", mano=mano)
    _edit(root, "train", "data", lambda content: content["images"][0].pop("camera"))
    with pytest.raises(ValueError, match=r"train_data\.json, image 0: it must have capture"):
        InterHand(root, split="train", mano=mano)
    (root / "annotations/train/InterHand2.6M_train_joint_3d.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"annotation file of train is missing: .*joint_3d"):
        InterHand(root, split="train", mano=mano)


def test_a_source_is_small_when_pickled(written: tuple[Path, list[PlantedFrame]], mano: Path):
    source = InterHand(written[0], split="val", mano=mano)
    stored = pickle.dumps(source)
    assert len(stored) < 20_000
    assert pickle.loads(stored)[0].view_names == source[0].view_names
    assert source.fingerprint() == pickle.loads(stored).fingerprint()
