"""FreiHAND: one camera, four backgrounds, and lists of labels too large for a JSON reader."""

import json
import pickle

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources.annotation_cache import json_rows
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
    assert len(FreiHAND(tmp_path, mano=mano)) == 2
    source = pickle.loads(pickle.dumps(FreiHAND(tmp_path, backgrounds=4, mano=mano)))
    assert (len(source), source.max_views) == (8, 1)
    for index in range(8):
        frame = source[index]
        assert frame.key == f"training/{index:08d}"
        assert frame.images[0].name.endswith(f"{index:08d}.jpg")
        np.testing.assert_array_equal(frame.T_cam_from_world, np.eye(4)[None])
        assert_is_planted(frame, planted, [index % 2])


def test_backgrounds_are_those_that_were_asked_for(tmp_path):
    write_freihand(tmp_path, backgrounds=2)
    assert len(FreiHAND(tmp_path, backgrounds=2)) == 4
    with pytest.raises(FileNotFoundError, match=r"background 3 is missing: expected .*00000004\.jpg"):
        FreiHAND(tmp_path, backgrounds=3)
    with pytest.raises(ValueError, match="`backgrounds` must be 1 to 4; got 5"):
        FreiHAND(tmp_path, backgrounds=5)
    for backgrounds, words in ((1, "the paper counts 32560"), (2, "the set's own count is 65120")):
        with pytest.raises(ValueError, match=f"has {2 * backgrounds} frames, and {words}"):
            FreiHAND(tmp_path, backgrounds=backgrounds, strict_counts=True)


def test_the_archive_of_the_evaluation_can_stand_alone(tmp_path):
    planted = write_freihand(tmp_path / "set", backgrounds=1)
    alone = tmp_path / "FreiHAND_v2_eval"
    (tmp_path / "set" / "training").rename(tmp_path / "set" / "evaluation")
    for path in (tmp_path / "set").glob("training_*.json"):
        path.rename(path.with_name(path.name.replace("training", "evaluation")))
    (tmp_path / "set").rename(alone)
    for root in (tmp_path, alone):
        source = FreiHAND(root, split="test")
        assert len(source) == 2
        assert source[1].key == "evaluation/00000001"
        assert_is_planted(source[1], planted, [1], pose=False)


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


def test_rows_of_a_list_are_an_array(tmp_path):
    rows = [[i + 0.5, -i * 1e-3] for i in range(100)] + [[float("nan"), float("inf")]]
    path = tmp_path / "rows.json"
    path.write_text(json.dumps(rows, indent=1))
    np.testing.assert_array_equal(json_rows(path, (2,)), np.array(rows, np.float32))


def test_bytes_that_are_no_text_are_named(tmp_path):
    path = tmp_path / "rows.json"
    path.write_bytes(b"[[1, 2], [3, \xff4]]")
    with pytest.raises(ValueError, match=r"rows\.json.*not UTF-8"):
        json_rows(path, (2,))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[1, 2], [3", "cut short"),
        ('{"a": 1}', "expected a list"),
        ("[[1, 2], [3]]", "row 1: expected"),
        ('[[1, "x"]]', "row 0: it must be lists of numbers"),
        ("", "expected a list"),
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
