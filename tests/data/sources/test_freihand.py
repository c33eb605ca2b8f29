"""FreiHAND: one camera, four backgrounds, and lists of labels too large for a JSON reader."""

import json
import pickle

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources import annotation_cache
from poem_jax.data.sources.annotation_cache import iterate_json_list, json_rows
from poem_jax.data.sources.freihand import FreiHAND
from poem_jax.miniatures.mano_stand_in import write_mano
from tests.data.sources.raw_trees import write_freihand
from tests.data.sources.test_dexycb import assert_is_planted


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_four_backgrounds_share_the_labels(tmp_path):
    planted = write_freihand(tmp_path / "FreiHAND_v2")
    mano = write_mano(tmp_path / "MANO_RIGHT.pkl")
    source = pickle.loads(pickle.dumps(FreiHAND(tmp_path, mano=mano)))
    assert (len(source), source.max_views) == (8, 1)
    for index in range(8):
        frame = source[index]
        assert frame.key == f"training/{index:08d}"
        assert frame.images[0].name.endswith(f"{index:08d}.jpg")
        np.testing.assert_array_equal(frame.T_cam_from_world, np.eye(4)[None])
        assert_is_planted(frame, planted, [index % 2])


def test_without_a_mano_file_there_is_no_pose(tmp_path):
    write_freihand(tmp_path, backgrounds=1)
    source = FreiHAND(tmp_path)
    assert len(source) == 2
    assert source[0].pose_cam is None


def test_bad_labels_are_named(tmp_path):
    write_freihand(tmp_path)
    path = tmp_path / "training_xyz.json"
    rows = json.loads(path.read_text())
    rows[1][3][0] = float("nan")
    path.write_text(json.dumps(rows))
    source = FreiHAND(tmp_path)
    assert source[0].key == "training/00000000"
    with pytest.raises(CorruptSampleError, match=r"training/00000001.*not finite"):
        source[1]
    path.write_text(json.dumps(rows[:1]))
    with pytest.raises(ValueError, match=r"equally long.*'xyz': 1"):
        FreiHAND(tmp_path)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"training_xyz\.json.*lmb\.informatik"):
        FreiHAND(tmp_path)
    with pytest.raises(FileNotFoundError, match="evaluation"):
        FreiHAND(tmp_path, split="test")


@pytest.mark.parametrize("chunk", [7, 64, 2**20])
def test_lists_are_read_in_pieces(tmp_path, monkeypatch, chunk):
    monkeypatch.setattr(annotation_cache, "_CHUNK", chunk)
    monkeypatch.setattr(annotation_cache, "_MAX_ROW", 6 if chunk == 7 else 40)
    rows = [[i, 0] for i in range(100)] if chunk == 7 else [[i + 0.5, -i * 1e-3] for i in range(100)]
    path = tmp_path / "rows.json"
    path.write_text(json.dumps(rows, indent=None if chunk == 7 else 1, separators=(",", ":")))
    assert list(iterate_json_list(path)) == rows
    np.testing.assert_array_equal(json_rows(path, (2,)), np.array(rows, np.float32))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[1, 2], [3", "beyond element 1"),
        ('{"a": 1}', "must be a JSON list"),
        ("[[1, 2], [3]]", "row 1: expected"),
        ('[[1, "x"]]', "row 0: it must be lists of numbers"),
        ("", "must be a JSON list"),
    ],
)
def test_damaged_lists_are_named(tmp_path, text, problem):
    path = tmp_path / "rows.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"rows\.json.*{problem}"):
        json_rows(path, (2,))
    assert not list((tmp_path / "cache").rglob("*.npy"))


def test_a_changed_list_is_read_anew(tmp_path):
    path = tmp_path / "rows.json"
    path.write_text("[[1, 2]]")
    assert json_rows(path, (2,)).tolist() == [[1, 2]]
    path.write_text("[[1, 2], [3, 4]]")
    assert json_rows(path, (2,)).tolist() == [[1, 2], [3, 4]]
