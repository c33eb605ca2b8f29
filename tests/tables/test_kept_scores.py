"""Scores that are kept: taken again for the very same weights, captures and condition, and for no others;
without the weights, for the same config."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.evaluation.captures import CaptureScores
from poem_jax.models.apply import init
from poem_jax.models.presets import TINY, V2_NANO
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.table_rigs import FRONT, captures_of
from poem_jax.tables.kept_scores import Question, ScoresFile, checksum_of_first_stage, marks_of
from poem_jax.tables.training_summary import Training
from poem_jax.training.first_stage import with_first_stage
from poem_jax.weights.store import flatten, unflatten
from tests.micro import MICRO

SCORES = CaptureScores({"mpvpe_mm": np.array([21.0, 2.5, 1 / 3]), "f_5": np.array([0.1, 0.2, 0.3])}, 1)
FAR = CaptureScores({"mpvpe_mm": np.array([7e4, 2.5, 1 / 3])}, 0)
TRAINED = Training("1000 steps", "{}")
UNKNOWN = Training()
WEIGHTS, OTHER_WEIGHTS = "a", "b"


def some_captures(rig=FRONT):
    small = replace(SyntheticConfig(), image_hw=(16, 16), supersample=1, num_backgrounds=2)
    dataset = SyntheticDataset(captures_of(rig, small), seed=1)
    return [dataset.sample(index, num_views=2) for index in range(26)]


@pytest.fixture(scope="module")
def captures():
    return some_captures()


@pytest.fixture(scope="module")
def ring(captures):
    """Two questions of the same captures."""
    return [Question(f"ring, {cameras} cameras", marks_of(captures)) for cameras in (8, 4)]


class Counted:
    def __init__(self, scores=SCORES):
        self.scores, self.calls = scores, 0

    def __call__(self):
        self.calls += 1
        return self.scores


@pytest.fixture
def file(tmp_path):
    return ScoresFile(tmp_path / "scores" / "v2-0.npz", V2_NANO, "first stage")


def assert_close(scores, expected=SCORES):
    assert scores.unsolved == expected.unsolved
    assert list(scores.rows) == list(expected.rows)
    for name, values in expected.rows.items():
        np.testing.assert_allclose(scores.rows[name], values, rtol=5e-4)


@pytest.mark.parametrize("expected", [SCORES, FAR])
def test_the_same_is_scored_once_and_read_whole(file, ring, expected):
    score = Counted(expected)
    first, *others = (file.scores(WEIGHTS, TRAINED, ring[0], score)[0] for _ in range(3))
    assert_close(first, expected)
    for other in others:
        for name, values in first.rows.items():
            np.testing.assert_array_equal(other.rows[name], values)
    assert score.calls == 1


def test_other_weights_configs_or_conditions_are_scored_anew(file, ring):
    score = Counted()
    for question in (*ring, *ring):
        file.scores(WEIGHTS, TRAINED, question, score)
    assert score.calls == 2
    for question in (*ring, *ring):
        file.scores(OTHER_WEIGHTS, TRAINED, question, score)
    assert score.calls == 4
    other = replace(file, config=TINY)
    other.scores(OTHER_WEIGHTS, TRAINED, ring[0], score)
    assert score.calls == 5
    assert other.scores_without_model(ring[0]) is not None
    assert file.scores_without_model(ring[0]) is None


def _moved_camera(one):
    T = np.array(one.cameras.T_cam_from_world)
    T[1, 0, 3] += 5e-4
    return one._replace(cameras=one.cameras._replace(T_cam_from_world=T))


def _other_vertices(one):
    vertices = np.array(one.vertices_world)
    vertices[97] += 5e-4
    return one._replace(vertices_world=vertices)


def _longer_lens(one):
    K = np.array(one.cameras.K)
    K[0, 0, 0] *= 1.001
    return one._replace(cameras=one.cameras._replace(K=K))


def _moved_middle(one):
    K = np.array(one.cameras.K)
    K[0, 1, 2] += 0.1
    return one._replace(cameras=one.cameras._replace(K=K))


def _brighter_view(one):
    views = np.array(one.views)
    views[0] = np.minimum(views[0].astype(int) + 1, 255)
    return one._replace(views=views)


@pytest.mark.parametrize(
    "change", [_moved_camera, _other_vertices, _longer_lens, _moved_middle, _brighter_view]
)
def test_other_captures_are_scored_anew(file, captures, change):
    score = Counted()
    others = [*captures[:25], change(captures[25])]
    for some in (captures, others, captures[:25]):
        file.scores(WEIGHTS, TRAINED, Question("front", marks_of(some)), score)
    assert score.calls == 3


def test_another_machine_that_rounds_otherwise_knows_the_captures_again(file, captures):
    score = Counted()
    rounded = [one._replace(vertices_world=one.vertices_world + 1e-6) for one in captures]
    for some in (captures, rounded, some_captures()):
        file.scores(WEIGHTS, TRAINED, Question("front", marks_of(some)), score)
    assert score.calls == 1


def test_without_its_weights_a_model_of_the_same_config_keeps_its_scores_and_how_it_was_trained(file, ring):
    for question in ring:
        file.scores(WEIGHTS, TRAINED, question, Counted())
    for question in ring:
        scores, training = file.scores_without_model(question)
        assert_close(scores)
        assert training == TRAINED
    assert file.scores_without_model(replace(ring[0], condition="front")) is None
    assert replace(file, config=TINY).scores_without_model(ring[0]) is None
    assert replace(file, path=file.path.with_name("v2-1.npz")).scores_without_model(ring[0]) is None


def test_how_it_was_trained_is_kept_where_the_run_is_gone_and_added_where_it_turns_up(file, ring):
    assert file.scores(WEIGHTS, UNKNOWN, ring[0], Counted())[1] == UNKNOWN
    assert file.scores(WEIGHTS, TRAINED, ring[0], Counted())[1] == TRAINED
    for training in (UNKNOWN, Training("another run in the same folder", "{}")):
        for question in ring:
            assert file.scores(WEIGHTS, training, question, Counted())[1] == TRAINED
    assert file.read().training == TRAINED


def test_on_another_first_stage_scores_count_only_with_their_weights(file, ring, caplog):
    score = Counted()
    file.scores(WEIGHTS, TRAINED, ring[0], score)
    other = replace(file, first_stage="another")
    assert other.scores_without_model(ring[0]) is None
    assert "another first stage" in caplog.text
    other.scores(WEIGHTS, TRAINED, ring[0], score)
    assert score.calls == 1


def test_new_weights_leave_nothing_of_the_old_ones(file, ring):
    file.scores(WEIGHTS, TRAINED, ring[1], Counted())
    file.scores(OTHER_WEIGHTS, UNKNOWN, ring[0], Counted())
    assert file.scores_without_model(ring[1]) is None
    assert file.scores_without_model(ring[0])[1] == UNKNOWN


def test_a_model_that_cannot_be_scored_keeps_nothing(file, ring):
    def diverged():
        raise ValueError("not finite")

    with pytest.raises(ValueError, match="not finite"):
        file.scores(WEIGHTS, TRAINED, ring[0], diverged)
    assert not file.path.exists()


@pytest.mark.parametrize("damage", ["cut", "[1, 2]", '{"conditions": []}', "text"])
def test_a_damaged_file_is_told_put_aside_and_made_anew(file, ring, caplog, damage):
    score = Counted()
    file.scores(WEIGHTS, TRAINED, ring[0], score)
    if damage == "cut":
        file.path.write_bytes(file.path.read_bytes()[:-40])
    elif damage == "text":
        file.path.write_text("scores")
    else:
        np.savez(file.path, about=np.array(damage))
    damaged = file.path.read_bytes()
    assert file.scores_without_model(ring[0]) is None
    for _ in range(2):
        assert_close(file.scores(WEIGHTS, TRAINED, ring[0], score)[0])
    assert score.calls == 2
    assert "cannot be read" in caplog.text
    assert file.path.with_suffix(".damaged").read_bytes() == damaged


def test_scores_that_cannot_be_kept_are_given_all_the_same(file, ring, caplog):
    file.path.parent.write_text("a file where the folder should be")
    assert_close(file.scores(WEIGHTS, TRAINED, ring[0], Counted())[0])
    assert "scores are not kept" in caplog.text


def test_a_first_stage_is_known_by_trunk_and_heat_maps_alone():
    """New weights of a second stage leave scores that were made without it alone."""
    params, others = (init(MICRO, key=jax.random.key(seed)) for seed in (1, 2))
    lent = with_first_stage(others, params, "donor")
    assert checksum_of_first_stage(lent) == checksum_of_first_stage(params) != checksum_of_first_stage(others)
    for name in ("trainable.trunk", "statistics.trunk", "trainable.heat_maps"):
        leaves = flatten(lent)
        moved = next(one for one in leaves if one.startswith(name))
        changed = unflatten({**leaves, moved: leaves[moved] + 1e-3}, lent)
        assert checksum_of_first_stage(changed) != checksum_of_first_stage(params), moved
