"""Cameras in another order, fewer, others, or moved: views keep their cameras, and the hand its place."""

import jax
import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch
from poem_jax.evaluation.robustness import (
    drop_cameras,
    noisy_extrinsics,
    replace_cameras,
    shuffle_cameras,
)
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle

SAMPLES, VIEWS = 64, 6
KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def batch() -> MultiViewBatch:
    """Views that hold their own numbers; the last samples have two views fewer, one of them in the middle."""
    rng = np.random.default_rng(0)
    number = np.arange(SAMPLES * VIEWS).reshape(SAMPLES, VIEWS)
    K = np.tile(np.diag([100.0, 100.0, 1.0]), (SAMPLES, VIEWS, 1, 1))
    R = rotation_from_axis_angle(rng.normal(0, 0.2, (SAMPLES, VIEWS, 3)))
    T = rigid(R, rng.normal(0, 0.1, (SAMPLES, VIEWS, 3)))
    T[..., 2, 3] += 1
    mask = np.ones((SAMPLES, VIEWS), bool)
    mask[40:, [2, 5]] = False
    joints = rng.normal(0, 0.05, (SAMPLES, 21, 3))
    uv = project(K, T, joints[:, None])[0]
    images = np.broadcast_to(number[..., None, None, None], (SAMPLES, VIEWS, 2, 2, 3))
    vertices = rng.normal(0, 0.05, (SAMPLES, 778, 3))
    return MultiViewBatch(images, Cameras(K, T, mask), joints, vertices, uv)


def shown(batch):
    """Numbers of the views, -1 where they are masked."""
    return np.where(batch.cameras.view_mask, np.asarray(batch.views)[:, :, 0, 0, 0], -1)


def check_views_keep_their_cameras(changed, batch):
    K, T_changed = (np.asarray(leaf, np.float64) for leaf in changed.cameras[:2])
    uv, _ = project(K, T_changed, batch.joints_world[:, None])
    np.testing.assert_allclose(uv, changed.keypoints_px, atol=1e-3)
    T = np.asarray(batch.cameras.T_cam_from_world).reshape(-1, 4, 4)
    valid = np.asarray(changed.cameras.view_mask)
    given = np.asarray(changed.views)[:, :, 0, 0, 0][valid]
    np.testing.assert_allclose(np.asarray(changed.cameras.T_cam_from_world)[valid], T[given], atol=1e-6)
    np.testing.assert_array_equal(changed.joints_world, batch.joints_world)
    np.testing.assert_array_equal(changed.vertices_world, batch.vertices_world)


def test_shuffled_views_are_the_same_in_another_order(batch):
    changed = shuffle_cameras(batch, key=KEY)
    check_views_keep_their_cameras(changed, batch)
    np.testing.assert_array_equal(np.sort(shown(changed)), np.sort(shown(batch)))
    assert np.asarray(changed.cameras.view_mask)[40:, :4].all(), "valid views come first"
    first = shown(changed)[:, 0] % VIEWS
    assert (np.bincount(first[:40], minlength=VIEWS) > 0).all(), "each view is the primary one somewhere"
    again, other = shuffle_cameras(batch, key=KEY), shuffle_cameras(batch, key=jax.random.key(4))
    np.testing.assert_array_equal(shown(again), shown(changed))
    assert (shown(other) != shown(changed)).any()


@pytest.mark.parametrize("num_views", [1, 3, 5])
def test_dropped_views_leave_so_many(batch, num_views):
    changed = drop_cameras(batch, num_views, key=KEY)
    check_views_keep_their_cameras(changed, batch)
    kept = (shown(changed) >= 0).sum(1)
    np.testing.assert_array_equal(kept, np.minimum(num_views, (shown(batch) >= 0).sum(1)))
    assert all(
        set(row[row >= 0]) <= set(whole) for row, whole in zip(shown(changed), shown(batch), strict=True)
    )


@pytest.mark.parametrize(("num_views", "num_replaced"), [(4, 0), (4, 1), (3, 2), (4, 4), (5, 3)])
def test_replaced_views_come_from_the_rest(batch, num_views, num_replaced):
    changed = replace_cameras(batch, num_views, num_replaced, key=KEY)
    check_views_keep_their_cameras(changed, batch)
    before, after = shown(batch), shown(changed)
    assert after.shape == (SAMPLES, num_views)
    spares = (before[:, num_views:] >= 0).sum(1)
    there = (before[:, :num_views] >= 0).sum(1)
    exchanged = (after != before[:, :num_views]).sum(1)
    np.testing.assert_array_equal(exchanged, np.minimum(np.minimum(num_replaced, spares), there))
    for row, rest in zip(after, before, strict=True):
        seen = row[row >= 0]
        assert len(set(seen)) == len(seen)
        assert set(seen) <= set(rest)


def test_noise_moves_and_turns_cameras_about_themselves(batch):
    still = noisy_extrinsics(batch, 0.0, 0.0, key=KEY)
    np.testing.assert_allclose(still.cameras.T_cam_from_world, batch.cameras.T_cam_from_world, atol=1e-6)
    changed = noisy_extrinsics(batch, 0.01, 0.02, key=KEY)
    T, T_noisy = (np.asarray(b.cameras.T_cam_from_world, np.float64) for b in (batch, changed))
    moved = invert_rigid(T_noisy)[..., :3, 3] - invert_rigid(T)[..., :3, 3]
    assert abs(moved.std() / 0.01 - 1) < 0.06
    cosine = (np.einsum("bvij,bvij->bv", T[..., :3, :3], T_noisy[..., :3, :3]) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    assert abs(np.sqrt((angle**2).mean() / 3) / 0.02 - 1) < 0.06
    for name in ("views", "keypoints_px", "joints_world", "vertices_world"):
        np.testing.assert_array_equal(getattr(changed, name), getattr(batch, name))


def test_wrong_counts_are_refused(batch):
    with pytest.raises(ValueError, match="`num_views` must be at least 1; got 0"):
        drop_cameras(batch, 0, key=KEY)
    with pytest.raises(ValueError, match="`num_replaced` must be 0 to `num_views` = 3; got 4"):
        replace_cameras(batch, 3, 4, key=KEY)
    with pytest.raises(ValueError, match=r"`num_views` must be from 1 to 5.*got 6"):
        replace_cameras(batch, 6, 3, key=KEY)
    with pytest.raises(ValueError, match=r"must not be negative; got -1\.0 and 0\.0"):
        noisy_extrinsics(batch, -1.0, 0.0, key=KEY)
