"""What is not finite ends a run or is left out, and its batch is kept."""

import logging
from dataclasses import replace

import cv2
import numpy as np
import pytest

from poem_jax.training.bad_steps import BadSteps, positions_in
from poem_jax.training.config import BatchShape

GOOD, BAD = {"loss": 1.0, "pose": 2.0}, {"loss": 1.0, "pose": np.inf}


@pytest.fixture
def watch(tmp_path, batch_at):
    """Rows 2 and 3 of step 6 lack a vertex."""

    def draw(step):
        batch = batch_at(step)
        if step != 6:
            return batch
        vertices = batch.vertices_world.copy()
        vertices[2:4, 5] = np.nan
        return batch._replace(vertices_world=vertices)

    def make(allowed=0, positions=None, key_at=None):
        return BadSteps(tmp_path, allowed, draw, positions, key_at)

    return make


def left_out(metrics, is_bad=1.0):
    return metrics | {"bad_step": is_bad}


def test_good_steps_pass(watch, tmp_path):
    steps = [(5, GOOD), (6, left_out(GOOD, 0.0))]
    assert watch().check(steps) == [GOOD, GOOD]
    assert not list(tmp_path.iterdir())


def test_the_first_bad_step_is_named_with_its_samples_and_its_batch(watch, tmp_path, micro_config):
    shapes = (BatchShape(3, 8), BatchShape(3, 16))
    positions = positions_in(replace(micro_config.data, batches=shapes))
    with pytest.raises(
        FloatingPointError,
        match=r"\{'pose': inf\} at step 6 \(samples 96 to 103 of the source\); .*bad_step_6.npz, its images "
        r"in bad_step_6.png; its data are not finite: vertices_world of sample 98, 99. .*skip_bad_steps",
    ):
        watch(positions=positions).check([(5, GOOD), (6, BAD), (7, BAD)])
    with np.load(tmp_path / "bad_step_6.npz") as kept:
        np.testing.assert_array_equal(kept["samples"], range(96, 104))
        assert np.isnan(kept["vertices_world"][2:4, 5]).all()
        assert kept["views"].shape == (8, 3, 32, 32, 3)
        views = kept["views"]
    picture = cv2.imread(str(tmp_path / "bad_step_6.png"))[..., ::-1]
    np.testing.assert_array_equal(picture[64:96, 32:64], views[2, 1])


def test_samples_of_a_mixture_are_named_as_their_users_know_them(watch):
    bad_steps = watch(key_at=lambda position, views: f"set {10 * position}/{views}")
    with pytest.raises(FloatingPointError, match=r"2, 3; sample 2 is set 20/3, 3 is set 30/3\. The"):
        bad_steps.check([(6, BAD)])


def test_finite_data_point_to_the_learning_rate(watch):
    with pytest.raises(FloatingPointError, match="its data are finite, so lower the learning rate"):
        watch().check([(5, BAD)])


def test_steps_are_left_out_until_there_are_too_many(watch, tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    bad_steps = watch(allowed=2)
    assert bad_steps.check([(4, left_out(BAD)), (5, left_out(GOOD, 0.0))]) == [GOOD]
    assert bad_steps.check([(6, left_out(GOOD))]) == []
    assert "left out: {'pose': inf} at step 4" in caplog.text
    assert "left out: a gradient or statistic that is not finite at step 6" in caplog.text
    with pytest.raises(FloatingPointError, match=r"at step 8;.* bad step 3 of this sitting.*allows 2"):
        bad_steps.check([(7, left_out(GOOD, 0.0)), (8, left_out(BAD))])
    assert bad_steps.left_out == [4, 6, 8]
    assert sorted(file.name for file in tmp_path.glob("*.npz")) == [f"bad_step_{n}.npz" for n in (4, 6, 8)]


def test_a_step_that_was_not_left_out_stops_also_where_some_may_be(watch):
    with pytest.raises(FloatingPointError, match=r"at step 5.*goes on from there$"):
        watch(allowed=9).check([(5, left_out(BAD, 0.0))])


def test_a_full_disk_hides_nothing(watch, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(
        FloatingPointError, match=r"'pose': inf.*could not be saved \(.*No space.*\); its data are not finite"
    ):
        watch().check([(6, BAD)])
