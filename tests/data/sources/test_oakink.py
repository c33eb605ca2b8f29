import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources.oakink import VIEW_NAMES, OakInk
from poem_jax.miniatures import oakink
from poem_jax.miniatures.scene import PlantedFrame
from tests.data.sources.planted import assert_planted


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[PlantedFrame]]:
    root = tmp_path_factory.mktemp("oakink")
    return root, oakink.write(root, frames=1)


@pytest.fixture
def root(written: tuple[Path, list[PlantedFrame]]) -> Path:
    return written[0]


@pytest.fixture
def as_it_comes(root: Path, tmp_path: Path) -> Path:
    """The set without what its toolkit makes of it; its labels may be changed."""
    return _copy(root, tmp_path / "as_it_comes", "anno")


def _copy(root: Path, new: Path, *parts: str) -> Path:
    for part in parts:
        shutil.copytree(root / "image" / part, new / "image" / part)
    (new / "image" / "stream_release_v2").symlink_to(root / "image" / "stream_release_v2")
    return new


@pytest.mark.parametrize("form", ["as written", "as it comes"])
def test_every_planted_hand_is_found(written: tuple[Path, list[PlantedFrame]], as_it_comes: Path, form: str):
    root, planted = written
    root = as_it_comes if form == "as it comes" else root
    by_key = {frame.key: frame for split in ("train+val", "test") for frame in OakInk(root, split=split)}
    assert by_key.keys() == {frame.key_hint for frame in planted}
    for expected in planted:
        frame = by_key[expected.key_hint]
        assert frame.view_names == VIEW_NAMES
        assert_planted(frame, expected)
        assert [image.data[:4] for image in frame.images] == [b"\x89PNG"] * 4


def test_each_hand_of_a_handover_is_a_sample(root: Path):
    hands: dict = {}
    for sequence, person, number in OakInk(root, split="train+val")._samples:
        hands.setdefault((sequence, number), set()).add(person)
    assert {0, 1} in hands.values()


def test_validation_and_training_are_the_parts_of_their_union(root: Path):
    parts = [set(OakInk(root, split=split)._samples) for split in ("train", "val", "train_val")]
    assert parts[0] | parts[1] == parts[2]
    assert not parts[0] & parts[1]


def test_a_quarter_is_every_fourth(root: Path, tmp_path: Path):
    image = tmp_path / "image"
    (image / "anno" / "general_info").mkdir(parents=True)
    (image / "stream_release_v2").mkdir()
    listed = image / "anno" / "split" / "split2" / "seq_train.json"
    listed.parent.mkdir(parents=True)
    # The lists of the set itself name single views, in any order.
    entries = [["A01001_0001_0000/2021-09-26", 0, fid, fid % 4] for fid in range(10)]
    listed.write_text(json.dumps(entries[::-1] + entries))
    assert len(OakInk(tmp_path)) == 10
    assert OakInk(tmp_path, quarter=True)._samples == OakInk(tmp_path)._samples[::4]
    assert [fid for _, _, fid in OakInk(tmp_path)._samples] == list(range(10))
    with pytest.raises(ValueError, match=r"10 frames, and the paper counts 58692"):
        OakInk(tmp_path, strict_counts=True)


def test_what_is_missing_is_named(root: Path, tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"stream_release_v2.*oakink\.net"):
        OakInk(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="`setup` must be one of SP0, SP1, SP2; got 'SP3'"):
        OakInk(root, setup="SP3")
    with pytest.raises(ValueError, match="`split` must be one of"):
        OakInk(root, split="evaluation")
    copy = _copy(root, tmp_path / "OakInk", "anno", "anno_mv", "anno_packed_mv")
    listed = copy / "image/anno_mv/split/split2/seq_test.json"
    entries = json.loads(listed.read_text())
    listed.write_text(json.dumps(entries[:-1]))
    with pytest.raises(ValueError, match=r"seq_test\.json: all 4 views.*\[0, 1, 2\]"):
        OakInk(copy, split="test")
    listed.write_text(json.dumps([["../../x/y", 0, 1, 2]]))
    with pytest.raises(ValueError, match=r"entry 0: expected \[pk, sid, fid, vid\]"):
        OakInk(copy, split="test")
    shutil.rmtree(copy / "image/anno_mv")
    (copy / "image/anno/split/split2/seq_test.json").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"the list of SP2 test is missing: expected .*seq_test\.json"
    ):
        OakInk(copy, split="test")


def test_bad_samples_are_named(as_it_comes: Path):
    source = OakInk(as_it_comes, split="test")
    key = source[0].key
    info = key.replace("/", "__") + "__2.pkl"
    joints = as_it_comes / "image/anno/hand_j" / info
    joints.write_bytes(pickle.dumps(np.full((21, 3), np.nan)))
    with pytest.raises(CorruptSampleError, match=f"sample {key}: `joints_cam` is not finite"):
        source[0]
    joints.write_bytes(pickle.dumps(np.zeros((20, 3))))
    with pytest.raises(
        CorruptSampleError, match=r"`hand_j` must be numbers of shape \(21, 3\); got \(20, 3\)"
    ):
        source[0]
    joints.write_bytes(pickle.dumps([[1.0, 2.0], [3.0]]))
    with pytest.raises(CorruptSampleError, match=rf"sample {key}: `hand_j` must be numbers .*inhomogeneous"):
        source[0]
    joints.write_bytes(b"cposix\nsystem\n(S'true'\ntR.")
    with pytest.raises(CorruptSampleError, match=r"hand_j.*asks for posix\.system"):
        source[0]
    joints.unlink()
    with pytest.raises(CorruptSampleError, match=r"no file at .*hand_j"):
        source[0]
    # Every system call on a name this long fails.
    joints.symlink_to("x" * 256)
    with pytest.raises(CorruptSampleError, match=rf"sample {key}.*hand_j"):
        source[0]
