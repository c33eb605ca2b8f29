import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch
from poem_jax.data.batching import collate, pad_batch, pad_views
from poem_jax.geometry.cameras import Cameras


def sample(views, seed=0, **optional):
    rng = np.random.default_rng(seed)
    K = rng.normal(size=(views, 3, 3)).astype(np.float32)
    T = rng.normal(size=(views, 4, 4)).astype(np.float32)
    return MultiViewBatch(
        views=rng.integers(1, 256, (views, 8, 6, 3), dtype=np.uint8),
        cameras=Cameras(K, T),
        joints_world=rng.normal(size=(21, 3)).astype(np.float32),
        vertices_world=rng.normal(size=(778, 3)).astype(np.float32),
        keypoints_px=rng.normal(size=(views, 21, 2)).astype(np.float32),
        **optional,
    )


def test_collate_pads_views_under_the_mask():
    samples = [sample(1, 1), sample(3, 2), sample(4, 3)]
    batch = collate(samples, 4)
    assert batch.views.shape == (3, 4, 8, 6, 3)
    assert batch.views.dtype == np.uint8
    np.testing.assert_array_equal(batch.cameras.view_mask.sum(-1), [1, 3, 4])
    assert (batch.views[~batch.cameras.view_mask] == 0).all()
    assert (batch.keypoints_px[~batch.cameras.view_mask] == 0).all()
    for i, one in enumerate(samples):
        views = one.views.shape[0]
        np.testing.assert_array_equal(batch.views[i, :views], one.views)
        np.testing.assert_array_equal(batch.cameras.K[i, :views], one.cameras.K)
        np.testing.assert_array_equal(
            batch.cameras.T_cam_from_world[i, views:],
            np.broadcast_to(one.cameras.T_cam_from_world[0], (4 - views, 4, 4)),
        )
        np.testing.assert_array_equal(batch.joints_world[i], one.joints_world)
    assert batch.pose is None
    assert batch.sample_mask is not None
    assert batch.sample_mask.all()


def test_optional_fields_are_stacked():
    batch = collate([sample(2, i, shape=np.full(10, i, np.float32)) for i in range(3)], 2)
    assert batch.shape is not None
    np.testing.assert_array_equal(batch.shape[:, 0], [0, 1, 2])


def test_pad_batch_repeats_under_the_mask():
    batch = collate([sample(2, i) for i in range(3)], 2)
    padded = pad_batch(batch, 5)
    assert padded.sample_mask is not None
    np.testing.assert_array_equal(padded.sample_mask, [True, True, True, False, False])
    np.testing.assert_array_equal(padded.views[:3], batch.views)
    np.testing.assert_array_equal(padded.cameras.K[3:], batch.cameras.K[[0, 0]])
    same = pad_batch(batch, 3)
    np.testing.assert_array_equal(same.joints_world, batch.joints_world)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        collate([], 4)
    with pytest.raises(ValueError, match="1 to 2 views; got 3"):
        collate([sample(3)], 2)
    with pytest.raises(ValueError, match="1 to 2 views; got 0"):
        pad_views(sample(0), 2)
    with pytest.raises(ValueError, match="`shape` must be present"):
        collate([sample(1), sample(1, shape=np.zeros(10, np.float32))], 1)
    with pytest.raises(ValueError, match="does not fit"):
        pad_batch(collate([sample(1), sample(1)], 1), 1)
