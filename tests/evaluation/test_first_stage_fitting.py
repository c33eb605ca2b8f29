"""Key points of a network's first stage, and the hand fitted to them."""

from dataclasses import replace

import numpy as np
import pytest

from poem_jax.data.batching import collate
from poem_jax.evaluation import first_stage_fitting
from poem_jax.evaluation.first_stage_fitting import FirstStageFitting
from poem_jax.models.presets import preset
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.table_rigs import FRONT, captures_of
from poem_jax.weights.store import SHIPPED, load
from tests.evaluation.test_captures import SMALL


@pytest.fixture(scope="module")
def batch():
    """Two captures, whose last camera is masked."""
    captures = SyntheticDataset(captures_of(FRONT, replace(SMALL, image_hw=(128, 128))), seed=3)
    batch = collate([captures.sample(index) for index in range(2)], 5)
    mask = batch.cameras.view_mask.copy()
    mask[:, 4] = False
    return batch._replace(cameras=batch.cameras._replace(view_mask=mask))


def see(monkeypatch, uv_px):
    """Let the first stage see these key points; return where it has put the hands otherwise."""
    weights, look, posed = np.ones(uv_px.shape[:-1], np.float32), first_stage_fitting._look, []

    def look_elsewhere(*args, **named):
        posed.append(look(*args, **named))
        return posed[-1]._replace(uv_px=uv_px, weights=weights)

    monkeypatch.setattr(first_stage_fitting, "_look", look_elsewhere)
    return posed


@pytest.mark.slow
def test_true_key_points_give_the_true_hand_and_masked_views_say_nothing(batch, monkeypatch):
    mask = batch.cameras.view_mask[..., None, None]
    see(monkeypatch, np.where(mask, batch.keypoints_px, np.nan))
    found = FirstStageFitting(*load(SHIPPED))(batch, ())
    assert found.valid.all()
    assert 1000 * np.linalg.norm(found.joints_world - batch.joints_world, axis=-1).mean() < 1.5


@pytest.mark.slow
def test_where_key_points_do_not_agree_the_hand_is_the_posed_template(batch, monkeypatch):
    """Of the first capture one view is seen, of the second all: the fit is taken where there is one."""
    uv = batch.keypoints_px.copy()
    uv[0, 1:], uv[:, 4] = np.nan, np.nan
    posed = see(monkeypatch, uv)
    found = FirstStageFitting(*load(SHIPPED))(batch, ())
    assert found.valid.tolist() == [False, True]
    np.testing.assert_array_equal(found.joints_world[0], posed[0].joints[0])
    np.testing.assert_array_equal(found.vertices_world[0], posed[0].vertices[0])
    errors = 1000 * np.linalg.norm(found.joints_world - batch.joints_world, axis=-1).mean(-1)
    assert errors[1] < 1.5 < errors[0] < 40


@pytest.mark.slow
def test_where_nothing_can_be_triangulated_the_hand_is_finite_and_not_valid(batch):
    """All cameras in one place."""
    T = batch.cameras.T_cam_from_world
    together = batch.cameras._replace(T_cam_from_world=np.repeat(T[:, :1], T.shape[1], 1))
    found = FirstStageFitting(*load(SHIPPED))(batch._replace(cameras=together), ())
    assert not found.valid.any()
    assert np.isfinite(found.joints_world).all()
    assert np.isfinite(found.vertices_world).all()


@pytest.mark.slow
def test_two_views_are_fitted_by_their_own_settings_beside_samples_of_more(batch):
    """A sample's hand does not depend on how many views its neighbour in the batch has."""
    mask = batch.cameras.view_mask.copy()
    mask[0, 2:] = False
    mixed = batch._replace(cameras=batch.cameras._replace(view_mask=mask))
    fit = FirstStageFitting(*load(SHIPPED))
    all_few = mask.copy()
    all_few[1, 2:] = False
    few = batch._replace(cameras=batch.cameras._replace(view_mask=all_few))
    both, two, many = fit(mixed, ()), fit(few, ()), fit(batch, ())
    np.testing.assert_allclose(both.joints_world[0], two.joints_world[0], atol=1e-5)
    np.testing.assert_allclose(both.joints_world[1], many.joints_world[1], atol=1e-5)


@pytest.mark.slow
def test_the_shipped_first_stage_beats_no_knowledge_by_far():
    small = replace(SMALL, image_hw=(128, 128), supersample=2)
    captures = SyntheticDataset(captures_of(FRONT, small), seed=3)
    batch = collate([captures.sample(index) for index in range(2)], 5)
    found = FirstStageFitting(*load(SHIPPED))(batch, ())
    assert 1000 * np.linalg.norm(found.joints_world - batch.joints_world, axis=-1).mean() < 25


def test_a_network_without_maps_of_all_joints_is_refused():
    with pytest.raises(ValueError, match="21 heat maps; got 1"):
        FirstStageFitting(preset("v2-small"), {})
    with pytest.raises(ValueError, match="21 heat maps; got 0"):
        FirstStageFitting(preset("mvp"), {})
