"""Systems scored on drawn captures: which views they get, and the numbers that come out."""

from dataclasses import replace

import numpy as np
import pytest

from poem_jax.data.augmentation_recipes import NONE
from poem_jax.evaluation.captures import (
    batches_of,
    mean_hands,
    mean_hands_rotated,
    primary_cameras,
    score_captures,
    score_hands,
    truth_of,
)
from poem_jax.evaluation.robustness import shuffle_cameras
from poem_jax.evaluation.systems import Answer
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.table_rigs import FRONT, captures_of

SMALL = replace(SyntheticConfig(), image_hw=(16, 16), supersample=1, num_backgrounds=2)


@pytest.fixture(scope="module")
def captures():
    dataset = SyntheticDataset(captures_of(FRONT, SMALL), seed=FRONT.test_seed)
    return [dataset.sample(index) for index in range(5)]


class Shifted:
    """Finds the true hand, some millimetres beside it; never the third one of a batch."""

    hand, image_hw, recipe = default_hand(), (16, 16), NONE
    least_views, takes_root, one_at_a_time = 1, False, False
    most_views: int | None = None

    def __init__(self, shift_mm=0.0):
        self.shift = np.array([shift_mm / 1000, 0, 0])
        self.batches = []

    def __call__(self, batch, seen):
        self.batches.append(batch)
        valid = np.arange(len(batch.views)) != 2
        return Answer(batch.joints_world + self.shift, batch.vertices_world + self.shift, valid)


def test_scores_are_of_every_capture_and_of_no_padding(captures):
    system = Shifted(3.0)
    scores = score_captures(system, captures, 3, batch_size=4)
    assert [batch.views.shape[:2] for batch in system.batches] == [(4, 3), (4, 3)]
    np.testing.assert_allclose(scores.rows["mpvpe_mm"], np.full(5, 3.0), rtol=1e-3)
    np.testing.assert_allclose(scores.rows["rr_mpvpe_mm"], np.zeros(5), atol=1e-3)
    assert scores.unsolved == 1  # the other one fills up the last batch


def test_scores_are_plain_means_of_distances(captures):
    truth = truth_of(captures)
    found = truth._replace(vertices=truth.vertices + np.random.default_rng(0).normal(0, 0.01, (5, 778, 3)))
    by_hand = 1000 * np.sqrt(((found.vertices - truth.vertices) ** 2).sum(-1)).mean(-1)
    np.testing.assert_allclose(score_hands(found, truth)["mpvpe_mm"], by_hand, rtol=1e-9)


def test_fewer_views_are_the_first_ones(captures):
    (batch,) = batches_of(captures, 2, batch_size=5)
    for row, capture in enumerate(captures):
        np.testing.assert_array_equal(batch.views[row], capture.views[:2])


def test_shuffled_cameras_are_the_same_for_all_and_other_ones_by_another_seed(captures):
    def order(seed):
        (batch,) = batches_of(captures, 5, batch_size=5, change=shuffle_cameras, seed=seed)
        found = []
        for row, capture in enumerate(captures):
            T = batch.cameras.T_cam_from_world[row]
            same = (T[:, None] == capture.cameras.T_cam_from_world[None]).all((-2, -1))
            assert (same.sum(0) == 1).all()
            found.append(same.argmax(1))
        return np.array(found)

    np.testing.assert_array_equal(order(0), order(0))
    assert (order(0) != order(1)).any()
    assert (order(0) != np.arange(5)).any()


def test_the_primary_camera_is_the_first_that_a_system_is_given(captures):
    of_all = np.stack([one.cameras.T_cam_from_world for one in captures])
    np.testing.assert_array_equal(primary_cameras(captures, 3, batch_size=2), of_all[:, 0])
    how = {"batch_size": 2, "change": shuffle_cameras, "seed": 3}
    shuffled = primary_cameras(captures, 5, **how)
    batches = [one for one in batches_of(captures, 5, **how)]
    given = np.concatenate([one.cameras.T_cam_from_world[one.sample_mask, 0] for one in batches])
    np.testing.assert_array_equal(shuffled, given)
    assert (shuffled != of_all[:, 0]).any()


def test_mean_hands_have_the_true_root_and_one_shape(captures):
    first = primary_cameras(captures, 5, batch_size=4)
    truth, constant, rotated = truth_of(captures), mean_hands(captures, first), mean_hands_rotated(captures)
    for hands in (constant, rotated):
        np.testing.assert_allclose(hands.joints[:, ROOT_JOINT], truth.joints[:, ROOT_JOINT], atol=1e-6)
        sizes = np.linalg.norm(hands.vertices - hands.joints[:, ROOT_JOINT, None], axis=-1)
        np.testing.assert_allclose(sizes, np.broadcast_to(sizes[0], sizes.shape), atol=1e-6)
    errors = [score_hands(hands, truth)["mpvpe_mm"].mean() for hands in (constant, rotated)]
    assert errors[1] < errors[0]


def test_systems_of_one_sample_at_a_time_are_refused(captures):
    system = Shifted()
    system.one_at_a_time = True
    with pytest.raises(ValueError, match="cannot be scored in batches"):
        score_captures(system, captures, 2)
