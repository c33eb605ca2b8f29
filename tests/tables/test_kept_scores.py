"""Scores that are kept: taken again for the very same weights, captures and condition, and for no others;
without the weights, for the same config."""

from dataclasses import replace

import numpy as np
import pytest

from poem_jax.evaluation.captures import CaptureScores
from poem_jax.models.presets import TINY, V2_NANO
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.table_rigs import FRONT, captures_of
from poem_jax.tables.kept_scores import Asked, KeptModel, known_by

SCORES = CaptureScores(
    {
        "mpvpe_mm": np.array([21.0, 2.5, 1 / 3]),
        "f_5": np.array([0.1, 0.2, 0.3]),
        "far": np.array([7e4, 1, 2]),
    },
    1,
)
CAPTURES = np.array([[0.1, -0.05, 0.02, 101.5], [0.0, 0.01, 0.3, 87.25]])
RING_8, RING_4 = (Asked(f"ring, {cameras} cameras", CAPTURES) for cameras in (8, 4))
OTHERS = replace(RING_8, captures=CAPTURES + np.array([2e-4, 0, 0, 0]))


def planted_model(folder, weights="a"):
    """Make a folder that has what a model's weights are known by."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "seal.json").write_text(weights)
    return folder


class Counted:
    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return SCORES


@pytest.fixture
def model(tmp_path):
    return planted_model(tmp_path / "v2-0")


@pytest.fixture
def kept(tmp_path):
    return KeptModel(tmp_path / "scores" / "v2-0.npz", V2_NANO)


def assert_the_same(scores):
    assert scores.unsolved == SCORES.unsolved
    assert scores.rows.keys() == SCORES.rows.keys()
    for name, values in SCORES.rows.items():
        np.testing.assert_allclose(scores.rows[name], values, rtol=5e-4)


def test_the_same_is_scored_once_and_read_whole(model, kept):
    score = Counted()
    first, *others = (kept.scores(model, "", RING_8, score) for _ in range(3))
    assert_the_same(first)
    for other in others:
        for name, values in first.rows.items():
            np.testing.assert_array_equal(other.rows[name], values)
    assert score.calls == 1


def test_other_weights_captures_or_conditions_are_scored_anew(model, kept):
    score = Counted()
    for asked in (RING_8, RING_4, RING_8, RING_4):
        kept.scores(model, "", asked, score)
    assert score.calls == 2
    kept.scores(model, "", OTHERS, score)
    assert score.calls == 3
    planted_model(model, "b")
    for asked in (RING_8, RING_4, RING_8):
        kept.scores(model, "", asked, score)
    assert score.calls == 5


def test_without_its_weights_a_model_of_the_same_config_keeps_its_scores_and_how_it_was_trained(model, kept):
    kept.scores(model, "2500 steps", RING_8, Counted())
    kept.scores(model, "", RING_4, Counted())
    for asked in (RING_8, RING_4):
        scores, training = kept.scores_without_model(asked)
        assert_the_same(scores)
        assert training == "2500 steps"
    assert kept.scores_without_model(Asked("front", CAPTURES)) is None
    assert kept.scores_without_model(OTHERS) is None
    assert replace(kept, config=TINY).scores_without_model(RING_8) is None
    assert replace(kept, file=kept.file.with_name("v2-1.npz")).scores_without_model(RING_8) is None


def test_new_weights_leave_nothing_of_the_old_ones(model, kept):
    kept.scores(model, "2000 steps", RING_4, Counted())
    kept.scores(planted_model(model, "b"), "", RING_8, Counted())
    assert kept.scores_without_model(RING_4) is None
    assert kept.scores_without_model(RING_8)[1] == ""


def test_a_model_that_cannot_be_scored_keeps_nothing(model, kept):
    def diverged():
        raise ValueError("not finite")

    with pytest.raises(ValueError, match="not finite"):
        kept.scores(model, "", RING_8, diverged)
    assert not kept.file.exists()


@pytest.mark.parametrize("damage", ["cut", "another", "text"])
def test_a_damaged_file_is_told_and_made_anew(model, kept, caplog, damage):
    score = Counted()
    kept.scores(model, "", RING_8, score)
    if damage == "cut":
        kept.file.write_bytes(kept.file.read_bytes()[:-40])
    elif damage == "text":
        kept.file.write_text("scores")
    else:
        np.savez(kept.file, about=np.array("[1, 2]"))
    assert kept.scores_without_model(RING_8) is None
    for _ in range(2):
        assert_the_same(kept.scores(model, "", RING_8, score))
    assert score.calls == 2
    assert "cannot be read and is made anew" in caplog.text


def test_scores_that_cannot_be_kept_are_given_all_the_same(model, kept, caplog):
    kept.file.parent.write_text("a file where the folder should be")
    assert_the_same(kept.scores(model, "", RING_8, Counted()))
    assert "scores are not kept" in caplog.text


@pytest.mark.parametrize(
    ("change", "same"),
    [
        (np.full(4, 1e-5), True),
        (np.array([0, 2e-4, 0, 0]), False),
        (np.array([0, 0, 0, 0.2]), False),
        (np.full(4, np.nan), False),
    ],
)
def test_captures_are_the_same_but_for_rounding(model, kept, change, same):
    score = Counted()
    for captures in (CAPTURES, CAPTURES + change):
        kept.scores(model, "", Asked("ring", captures), score)
    assert score.calls == (1 if same else 2)
    kept.scores(model, "", Asked("ring", CAPTURES[:1]), score)
    assert score.calls == (2 if same else 3)


def test_captures_are_known_by_where_the_hand_is_and_how_bright_the_pictures_are():
    small = replace(SyntheticConfig(), image_hw=(16, 16), supersample=1, num_backgrounds=2)
    dataset = SyntheticDataset(captures_of(FRONT, small), seed=1)
    captures = [dataset.sample(index, num_views=1) for index in range(11)]
    known = known_by(captures)
    assert known.shape == (2, 4)
    for row, one in zip(known, (captures[0], captures[10]), strict=True):
        np.testing.assert_allclose(row, [*one.joints_world[9], one.views.mean()], rtol=1e-6)
