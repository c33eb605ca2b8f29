"""Scores that are kept: taken again for the very same weights, captures and condition, and for no others."""

from dataclasses import replace

import numpy as np
import pytest

from poem_jax.evaluation.captures import CaptureScores
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.table_rigs import FRONT, captures_of
from poem_jax.tables.kept_scores import fingerprint, kept_scores

SCORES = CaptureScores({"mpvpe_mm": np.array([1.0, 2.5, 1 / 3]), "f_5": np.array([0.1, 0.2, 0.3])}, 1)


def planted_model(folder, weights="a"):
    """Make a folder that has what a model's is known by."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text("{}")
    (folder / "seal.json").write_text(weights)
    return folder


class Counted:
    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return SCORES


def test_the_same_is_scored_once_and_read_whole(tmp_path):
    model, score = planted_model(tmp_path / "v2-0"), Counted()
    for _ in range(3):
        kept = kept_scores(model, "ring, 8 cameras", "c", score)
        assert kept.unsolved == 1
        assert kept.rows.keys() == SCORES.rows.keys()
        for name, values in SCORES.rows.items():
            np.testing.assert_array_equal(kept.rows[name], values)
    assert score.calls == 1


def test_other_weights_captures_or_conditions_are_scored_anew(tmp_path):
    model, score = planted_model(tmp_path / "v2-0"), Counted()
    kept_scores(model, "ring, 8 cameras", "c", score)
    kept_scores(model, "ring, 4 cameras", "c", score)
    kept_scores(model, "ring, 8 cameras", "d", score)
    planted_model(model, "b")
    kept_scores(model, "ring, 8 cameras", "d", score)
    (model / "config.json").write_text('{"width": 1}')
    kept_scores(model, "ring, 8 cameras", "d", score)
    kept_scores(planted_model(tmp_path / "v1-0", "b"), "ring, 8 cameras", "d", score)
    assert score.calls == 6


def test_a_model_that_cannot_be_scored_keeps_nothing(tmp_path):
    model = planted_model(tmp_path / "v2-0")

    def diverged():
        raise ValueError("not finite")

    with pytest.raises(ValueError, match="not finite"):
        kept_scores(model, "ring", "c", diverged)
    assert not list(tmp_path.rglob("*.scores/*"))


@pytest.mark.parametrize("damage", ['{"of": {"cond', "[1, 2]", "7"])
def test_a_damaged_file_is_told_and_scored_anew(tmp_path, caplog, damage):
    model, score = planted_model(tmp_path / "v2-0"), Counted()
    kept_scores(model, "ring", "c", score)
    (file,) = tmp_path.glob("*.scores/*.json")
    file.write_text(damage)
    for _ in range(2):
        assert kept_scores(model, "ring", "c", score).unsolved == 1
    assert score.calls == 2
    assert "cannot be read and is scored anew" in caplog.text


def test_scores_that_cannot_be_kept_are_given_all_the_same(tmp_path, caplog):
    model = planted_model(tmp_path / "v2-0")
    (tmp_path / "v2-0.scores").write_text("a file where the folder should be")
    assert kept_scores(model, "ring", "c", Counted()).unsolved == 1
    assert "scores are not kept" in caplog.text


def test_captures_are_known_by_images_cameras_and_labels():
    small = replace(SyntheticConfig(), image_hw=(16, 16), supersample=1, num_backgrounds=2)
    captures = [SyntheticDataset(captures_of(FRONT, small), seed=1).sample(index) for index in range(2)]
    first = captures[0]
    moved = first.cameras.T_cam_from_world + 1e-3
    others = (
        first._replace(views=first.views + 1),
        first._replace(cameras=first.cameras._replace(T_cam_from_world=moved)),
        first._replace(vertices_world=first.vertices_world + 1e-3),
    )
    prints = {fingerprint([one, captures[1]]) for one in (first, *others)}
    assert len(prints) == 4
    assert fingerprint(captures) in prints
    assert fingerprint(captures[::-1]) not in prints
