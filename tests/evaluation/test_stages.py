"""Errors of a model one part of which is replaced, on captures and a model made up here."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import poem_jax
from poem_jax.data.batching import collate
from poem_jax.evaluation.stages import StageErrors, format_stages, paired_difference, stage_errors
from poem_jax.models.config import FirstQueries, RootConfig
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset

VIEWS, SAMPLES = 2, 4


@pytest.fixture(scope="module")
def captures(micro_model) -> SyntheticDataset:
    config, _ = micro_model
    synthetic = SyntheticConfig(image_hw=config.image_hw, num_views=VIEWS, num_backgrounds=2)
    return SyntheticDataset(synthetic, seed=3)


@pytest.fixture(scope="module")
def errors(micro_model, captures) -> StageErrors:
    config, params = micro_model
    return stage_errors(params, config, captures, samples=SAMPLES, num_views=VIEWS, batch_size=SAMPLES)


def test_its_own_features_give_what_apply_gives(micro_model, captures, errors) -> None:
    config, params = micro_model
    batch = collate([captures.sample(i, num_views=VIEWS) for i in range(SAMPLES)], VIEWS)
    found = poem_jax.apply(params, batch.views, batch.cameras, config=config)
    expected = 1000 * np.linalg.norm(found.vertices_world - batch.vertices_world, axis=-1).mean(-1)
    np.testing.assert_allclose(errors.own, expected, rtol=1e-4)


def test_a_second_stage_that_moves_nothing_does_not_notice(errors) -> None:
    """A fresh model starts at the template and moves nothing, whatever it reads."""
    for other in (errors.zero, errors.another):
        assert paired_difference(other, errors.own) == (0.0, 0.0)
    np.testing.assert_allclose(errors.layers, errors.own[:, None].repeat(errors.layers.shape[1], 1))
    # Its first stage finds the root alone.
    assert np.isnan(errors.posed).all()


def test_the_true_root_is_given_as_apply_takes_it(micro_model, captures, errors) -> None:
    config, params = micro_model
    batch = collate([captures.sample(i, num_views=VIEWS) for i in range(SAMPLES)], VIEWS)
    root = batch.joints_world[:, 9]
    found = poem_jax.apply(params, batch.views, batch.cameras, config=config, root_world=root)
    expected = 1000 * np.linalg.norm(found.vertices_world - batch.vertices_world, axis=-1).mean(-1)
    np.testing.assert_allclose(errors.true_root, expected, rtol=1e-4)


@pytest.fixture(scope="module")
def joints_model(micro_model):
    """A fresh model that finds all joints and poses the template by them."""
    config, _ = micro_model
    decoder = replace(config.decoder, first_queries=FirstQueries.JOINTS)
    config = replace(config, root=RootConfig(num_joints=21), decoder=decoder)
    return config, poem_jax.init(config, key=jax.random.key(0))


@pytest.fixture(scope="module")
def joints_errors(joints_model, captures) -> StageErrors:
    config, params = joints_model
    return stage_errors(params, config, captures, samples=SAMPLES, num_views=VIEWS, batch_size=SAMPLES)


def test_a_fresh_model_stands_where_its_first_stage_poses_the_template(joints_errors) -> None:
    np.testing.assert_allclose(joints_errors.posed, joints_errors.own, atol=0.05)


class Changed:
    """Captures, each changed."""

    def __init__(self, captures, change) -> None:
        self._captures, self._change = captures, change

    def render_sample(self, index, num_views=None):
        return self._change(self._captures.render_sample(index, num_views))


def test_what_cannot_be_triangulated_is_not_posed(joints_model, captures) -> None:
    """All cameras are one: the template stands where the model starts, not folded up in a camera."""

    def one_camera(rendered):
        K, T, mask = rendered.batch.cameras
        cameras = rendered.batch.cameras._replace(K=K[[0, 0]], T_cam_from_world=T[[0, 0]], view_mask=mask)
        views = rendered.batch.views[[0, 0]]
        return rendered._replace(batch=rendered.batch._replace(cameras=cameras, views=views))

    config, params = joints_model
    changed = Changed(captures, one_camera)
    errors = stage_errors(params, config, changed, samples=2, num_views=VIEWS, batch_size=2)
    np.testing.assert_allclose(errors.posed, errors.own, atol=0.05)


def test_masked_views_are_refused(joints_model, captures) -> None:
    def masked(rendered):
        cameras = rendered.batch.cameras._replace(view_mask=np.array([True, False]))
        return rendered._replace(batch=rendered.batch._replace(cameras=cameras))

    config, params = joints_model
    with pytest.raises(ValueError, match="some are masked"):
        stage_errors(params, config, Changed(captures, masked), samples=2, num_views=VIEWS, batch_size=2)


@pytest.mark.parametrize("shown", [True, False])
def test_errors_of_hidden_joints_are_told_apart(joints_model, captures, shown: bool) -> None:
    def all_alike(rendered):
        return rendered._replace(joint_visible=np.full_like(rendered.joint_visible, shown))

    config, params = joints_model
    changed = Changed(captures, all_alike)
    errors = stage_errors(params, config, changed, samples=2, num_views=VIEWS, batch_size=2)
    np.testing.assert_allclose(errors.hidden_share, 0 if shown else 1)


def test_key_points_are_measured_in_hands(joints_model, joints_errors, captures) -> None:
    """Fresh heat maps are even nearly, so that their expectation lies in the middle of every crop."""
    config, _ = joints_model
    for index, found in enumerate(joints_errors.keypoint_share):
        truth = np.asarray(captures.sample(index, num_views=VIEWS).keypoints_px)
        extent = np.ptp(truth, axis=1).max(-1)[:, None]
        middle = np.array(config.image_hw[::-1]) / 2
        expected = (np.linalg.norm(truth - middle, axis=-1) / extent).mean()
        assert found == pytest.approx(expected, rel=0.2)


def test_true_joints_pose_the_template_well(joints_errors) -> None:
    assert np.all(joints_errors.true_joints < 6)
    assert np.all(joints_errors.true_joints < joints_errors.own)


def test_the_table_names_every_part(joints_errors) -> None:
    text = format_stages({VIEWS: joints_errors})
    title, header, _, row, *legend = text.splitlines()
    for column in ("posed", "layer 1", "zero", "another", "true root", "true joints", "2D %", "hidden %"):
        assert column in header
    assert f"{joints_errors.own.mean():.2f}" in row
    assert f"of {SAMPLES} captures" in title
    explained = " ".join(legend)
    for name in ("posed", "layer n", "zero", "another", "true root", "true joints", "2D %", "hidden %"):
        assert name in explained


def test_a_second_stage_that_reads_its_features_does(micro_model, captures) -> None:
    """The same model once its last layer moves the queries."""
    config, params = micro_model
    rng = np.random.default_rng(0)

    def disturb(leaf):
        return np.asarray(leaf + 0.05 * rng.normal(size=leaf.shape), np.float32)

    disturbed = {**params, "trainable": jax.tree.map(disturb, params["trainable"])}
    errors = stage_errors(disturbed, config, captures, samples=SAMPLES, num_views=VIEWS, batch_size=SAMPLES)
    for other in (errors.zero, errors.another):
        assert np.abs(other - errors.own).max() > 1e-3


def test_a_paired_difference_is_of_the_pairs() -> None:
    reference = np.array([1.0, 50.0, 9.0, 20.0])
    mean, error = paired_difference(reference + np.array([1.0, 3.0, 1.0, 3.0]), reference)
    assert mean == pytest.approx(2)
    assert error == pytest.approx(np.sqrt(4 / 3) / 2)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ({"samples": 5, "batch_size": 4}, "multiple of `batch_size`.*got 5 and 4"),
        ({"samples": 1, "batch_size": 1}, "at least 2.*got 1 and 1"),
        ({"num_views": 1, "batch_size": 4}, "`num_views` must be at least 2"),
    ],
)
def test_counts_are_checked(micro_model, captures, counts: dict, message: str) -> None:
    config, params = micro_model
    with pytest.raises(ValueError, match=message):
        stage_errors(params, config, captures, **{"samples": 4, "num_views": 2} | counts)
