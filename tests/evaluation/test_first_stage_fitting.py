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


@pytest.mark.slow
def test_true_key_points_give_the_true_hand_and_masked_views_say_nothing(monkeypatch):
    captures = SyntheticDataset(captures_of(FRONT, replace(SMALL, image_hw=(128, 128))), seed=3)
    batch = collate([captures.sample(index) for index in range(2)], 5)
    K, T, mask = batch.cameras
    mask = mask.copy()
    mask[:, 4] = False
    uv = np.where(mask[..., None, None], batch.keypoints_px, np.nan)
    weights = np.ones(uv.shape[:-1], np.float32)
    monkeypatch.setattr(first_stage_fitting, "_key_points", lambda *args, **named: (uv, weights))
    found = FirstStageFitting(*load(SHIPPED))(batch._replace(cameras=type(batch.cameras)(K, T, mask)), ())
    assert found.valid.all()
    assert 1000 * np.linalg.norm(found.joints_world - batch.joints_world, axis=-1).mean() < 1.5


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
