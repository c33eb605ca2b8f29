import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources.arctic import SMPLX_TIPS, Arctic
from poem_jax.geometry.cameras import project_cam
from poem_jax.io.npy_dict import load_npy_dict
from poem_jax.miniatures import arctic
from poem_jax.miniatures.mano_stand_in import write_mano
from poem_jax.miniatures.scene import PlantedFrame
from tests.data.sources.planted import assert_planted


@pytest.fixture(scope="module")
def mano(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[PlantedFrame]]:
    root = tmp_path_factory.mktemp("arctic")
    return root, arctic.write(root, frames=1)


@pytest.fixture
def data(written: tuple[Path, list[PlantedFrame]], tmp_path: Path) -> Path:
    """A copy of all but the images, which are linked; it may be changed."""
    original, folder = written[0] / "arctic_data" / "data", tmp_path / "data"
    for part in ("raw_seqs", "meta", "splits_json"):
        shutil.copytree(original / part, folder / part)
    (folder / "images").symlink_to(original / "images")
    return folder


def test_every_planted_hand_is_found(written: tuple[Path, list[PlantedFrame]], mano: Path):
    root, planted = written
    by_key = {
        frame.key: frame for split in ("train", "val") for frame in Arctic(root, split=split, mano=mano)
    }
    assert by_key.keys() == {frame.key_hint for frame in planted}
    for expected in planted:
        assert_planted(by_key[expected.key_hint], expected)


def test_tips_are_those_of_smplx(written: tuple[Path, list[PlantedFrame]], mano: Path):
    frame = Arctic(written[0], split="val", mano=mano)[0]
    tips = frame.vertices_cam[:, list(SMPLX_TIPS)]
    np.testing.assert_allclose(frame.joints_cam[:, 4::4], tips, atol=1e-6)


def test_ends_of_sequences_and_the_offset_of_images_count(data: Path, mano: Path):
    misc = data / "meta" / "misc.json"
    held = json.loads(misc.read_text())
    source = Arctic(data, split="val", mano=mano)
    path = next((data / "raw_seqs" / "s05").glob("*.mano.npy"))
    rows = len(load_npy_dict(path)["right"]["rot"])
    assert len(source) == rows - 20
    first = source[0]
    # One image later shows the same row: with a larger offset the hand of an image is another row's.
    held["s05"]["ioi_offset"] += 1
    misc.write_text(json.dumps(held))
    moved = Arctic(data, split="val", mano=mano)
    assert moved[0].key == first.key
    assert np.abs(moved[0].joints_cam - first.joints_cam).max() > 1e-4
    # Images before row 0 have no label.
    held["s05"]["ioi_offset"] = 12
    misc.write_text(json.dumps(held))
    assert len(Arctic(data, split="val", mano=mano)) == max(0, rows - 22)


def test_left_hands_come_as_right_ones(data: Path, tmp_path: Path):
    left = write_mano(tmp_path / "MANO_LEFT.pkl", side="left")
    frame = Arctic(data, split="val", mano=left, hand="left")[0]
    assert frame.mirror_px is not None
    np.testing.assert_allclose(frame.mirror_px, frame.K[:, 0, 2])
    np.testing.assert_allclose(project_cam(frame.K, frame.joints_cam), frame.keypoints_px, atol=1e-2)


def test_options_are_checked(data: Path, mano: Path, tmp_path: Path):
    with pytest.raises(ValueError, match="the labels of the test subject are not public"):
        Arctic(data, split="test", mano=mano)
    with pytest.raises(ValueError, match="there is no second view"):
        Arctic(data, setup="p2", mano=mano)
    with pytest.raises(ValueError, match="must be a left hand"):
        Arctic(data, mano=mano, hand="left")
    with pytest.raises(FileNotFoundError, match="MANO_RIGHT"):
        Arctic(data, mano=tmp_path / "MANO_RIGHT.pkl")
    with pytest.raises(ValueError, match="has 1 frames, and the paper counts 17392"):
        Arctic(data, split="val", mano=mano, strict_counts=True)


def test_what_is_missing_is_named(data: Path, mano: Path, tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"raw_seqs.*arctic\.is\.tue"):
        Arctic(tmp_path / "nowhere", mano=mano)
    (data / "images").unlink()
    (data / "cropped_images").mkdir()
    with pytest.raises(FileNotFoundError, match="`cropped_images` cannot serve"):
        Arctic(data, mano=mano)
    (data / "images").mkdir()
    with pytest.raises(CorruptSampleError, match=r"images.*00010.*cannot be read"):
        Arctic(data, split="val", mano=mano)[0]
    (data / "splits_json" / "protocol_p1.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"the protocol is missing: expected .*protocol_p1\.json"):
        Arctic(data, mano=mano)


def test_bad_labels_are_named(data: Path, mano: Path):
    path = next((data / "raw_seqs" / "s05").glob("*.mano.npy"))
    held = load_npy_dict(path)
    source = Arctic(data, split="val", mano=mano)
    held["right"]["trans"][:] = np.nan
    _save(path, held)
    with pytest.raises(CorruptSampleError, match=r"mano\.npy, sample s05/.*not finite"):
        Arctic(data, split="val", mano=mano)[0]
    del held["right"]["trans"]
    _save(path, held)
    with pytest.raises(ValueError, match=r"mano\.npy.*`right` must have `trans`"):
        Arctic(data, split="val", mano=mano)
    assert source.fingerprint()
    misc = data / "meta" / "misc.json"
    cameras = json.loads(misc.read_text())
    whole = cameras["s05"]["world2cam"]
    for value, problem in (
        (whole[:7], r"must have shape \(8, 4, 4\)"),
        ([*whole[:7], [[1]]], "must be numbers"),
        ([*whole[:7], [["a"] * 4] * 4], "must be numbers"),
    ):
        cameras["s05"]["world2cam"] = value
        misc.write_text(json.dumps(cameras))
        with pytest.raises(ValueError, match=rf"misc\.json: `world2cam` of s05 {problem}"):
            Arctic(data, split="val", mano=mano)


def test_a_source_can_be_pickled(written: tuple[Path, list[PlantedFrame]], mano: Path):
    source = Arctic(written[0], split="val", mano=mano)
    stored = pickle.dumps(source)
    assert len(stored) < 20_000
    assert pickle.loads(stored)[0].key == source[0].key


def _save(path: Path, held: dict) -> None:
    np.save(path, np.array(held, dtype=object), allow_pickle=True)
