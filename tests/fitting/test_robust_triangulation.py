import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.fitting import Observations, triangulate_robust
from poem_jax.fitting.robust_triangulation import MAX_PAIRS, _pairs
from poem_jax.geometry.cameras import project, projection_jacobian
from tests.fitting.observed import observed

robust = jax.jit(triangulate_robust, static_argnames="frame_axis")


def error_mm(points, take):
    return 1000 * np.linalg.norm(np.asarray(points) - take.joints, axis=-1)


@pytest.mark.parametrize("views", [2, 4])
def test_clean_points_are_exact(takes, views):
    take = takes(3, views, 0.0, 1)
    found = robust(observed(take), frame_axis=0)
    assert bool(found.valid.all())
    assert bool(found.inlier_mask.all())
    assert error_mm(found.points, take).max() < 0.01


def test_an_outlier_is_found_and_ignored(takes):
    take = takes(3, 4, 0.5, 2)
    uv = take.uv_px.copy()
    uv[:, 1, ::2] += 50
    found = robust(observed(take, uv_px=uv), frame_axis=0)
    expected = np.ones(uv.shape[:-1], bool)
    expected[:, 1, ::2] = False
    np.testing.assert_array_equal(found.inlier_mask, expected)
    mask = robust(observed(take, uv_px=uv, weights=expected.astype(np.float32)), frame_axis=0)
    np.testing.assert_allclose(found.points, mask.points, atol=1e-6)


def test_the_order_of_views_does_not_matter(takes):
    take = takes(3, 4, 2.0, 3, outlier_share=0.1)
    order = np.array([2, 0, 3, 1])
    straight = robust(observed(take), frame_axis=0)
    turned = robust(
        Observations(take.uv_px[:, order], None, take.K[order], take.T_cam_from_world[order]), frame_axis=0
    )
    np.testing.assert_array_equal(straight.inlier_mask[:, order], turned.inlier_mask)
    np.testing.assert_allclose(straight.points, turned.points, atol=2e-6)


@pytest.mark.parametrize("how", ["nan pixel", "nan weight", "zero weight", "negative weight"])
def test_what_is_unseen_changes_nothing(takes, how):
    take = takes(3, 4, 1.0, 4)
    uv, weights = take.uv_px.copy(), np.ones(take.uv_px.shape[:-1], np.float32)
    if how == "nan pixel":
        uv[:, 3] = np.nan
    else:
        uv[:, 3] = 1e9
        weights[:, 3] = {"nan": np.nan, "zero": 0, "negative": -1}[how.split()[0]]
    found = robust(observed(take, uv_px=uv, weights=weights), frame_axis=0)
    three = robust(Observations(take.uv_px[:, :3], None, take.K[:3], take.T_cam_from_world[:3]), frame_axis=0)
    np.testing.assert_allclose(found.points, three.points, atol=2e-6)
    np.testing.assert_allclose(found.sigma_m, three.sigma_m, rtol=1e-3)


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_scale_of_confidences_does_not_matter(takes, scale):
    take = takes(3, 4, 2.0, 4, outlier_share=0.1)
    confidence = np.random.default_rng(0).uniform(0.3, 1, take.uv_px.shape[:-1]).astype(np.float32)
    one, other = (
        robust(observed(take, weights=c), frame_axis=0) for c in (confidence, np.float32(scale) * confidence)
    )
    np.testing.assert_array_equal(one.inlier_mask, other.inlier_mask)
    np.testing.assert_allclose(one.points, other.points, atol=1e-6)
    np.testing.assert_allclose(one.sigma_m, other.sigma_m, rtol=1e-4)


def test_sigma_is_calibrated_where_the_noise_differs(takes):
    """Confidence is inverse variance: points of a quarter of it are twice as noisy."""
    take = takes(60, 4, 0.0, 8)
    rng = np.random.default_rng(1)
    confidence = rng.choice([0.25, 1.0], take.uv_px.shape[:-1]).astype(np.float32)
    noise = rng.normal(size=take.uv_px.shape) / np.sqrt(confidence)[..., None]
    noisy = (take.uv_px + noise).astype(np.float32)
    found = robust(observed(take, uv_px=noisy, weights=confidence), frame_axis=0)
    inside = np.abs(found.points - take.joints) < found.sigma_m[..., None]
    assert 0.60 < inside[np.asarray(found.valid)].mean() < 0.76
    assert found.inlier_mask.mean() > 0.99


def test_a_camera_that_is_not_known_changes_nothing(takes):
    take = takes(3, 4, 1.0, 4)
    K, T = take.K.copy(), take.T_cam_from_world.copy()
    K[1], T[1] = np.nan, np.nan
    found = robust(observed(take, K=K, T_cam_from_world=T), frame_axis=0)
    kept = [0, 2, 3]
    others = robust(
        Observations(take.uv_px[:, kept], None, take.K[kept], take.T_cam_from_world[kept]), frame_axis=0
    )
    np.testing.assert_allclose(found.points, others.points, atol=1e-6)
    np.testing.assert_allclose(found.sigma_px, others.sigma_px, rtol=1e-5)


def test_joints_seen_by_one_view_are_not_invented(takes):
    take = takes(3, 4, 1.0, 5)
    uv = take.uv_px.copy()
    uv[:, 1:, 4] = np.nan
    found = robust(observed(take, uv_px=uv), frame_axis=0)
    assert not found.valid[:, 4].any()
    assert bool(np.delete(np.asarray(found.valid), 4, axis=1).all())
    assert (np.asarray(found.points)[:, 4] == 0).all()
    assert not found.inlier_mask[:, :, 4].any()


def test_projection_jacobian_matches_differences(takes, float64):
    take = takes(1, 2, 0.0, 6)
    points = jnp.asarray(take.joints, jnp.float64)[0]
    K, T = take.K.astype(float), take.T_cam_from_world.astype(float)
    pixels, J = projection_jacobian(K, T, points)
    np.testing.assert_allclose(pixels, project(K, T, points[None])[0], rtol=1e-9)
    for c in range(3):
        step = 1e-6 * np.eye(3)[c]
        ahead, back = (project(K, T, (points + s * step)[None])[0] for s in (1, -1))
        np.testing.assert_allclose(J[..., c], (ahead - back) / 2e-6, rtol=1e-5, atol=1e-4)


def test_gradients_are_finite_and_right(takes, float64):
    take = takes(1, 3, 1.0, 7)
    uv, K, T = (jnp.asarray(x, jnp.float64) for x in (take.uv_px[0], take.K, take.T_cam_from_world))
    value = jax.jit(lambda uv: triangulate_robust(Observations(uv, None, K, T)).points[3, 0])
    gradient = jax.grad(value)(uv)
    assert bool(jnp.isfinite(gradient).all())
    step = jnp.zeros_like(uv).at[1, 3, 0].set(1e-3)
    assert gradient[1, 3, 0] == pytest.approx(float(value(uv + step) - value(uv - step)) / 2e-3, rel=1e-2)


def test_sigma_is_calibrated(takes):
    """Per coordinate: the share of |error| below the standard deviation of that coordinate."""
    take = takes(60, 4, 2.0, 8)
    found = robust(observed(take), frame_axis=0)
    deviation = np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1))
    inside = np.abs(found.points - take.joints) < deviation
    assert 0.6 < inside.mean() < 0.76
    assert float(found.sigma_px[0]) == pytest.approx(2.0, rel=0.1)


def test_the_noise_is_known_in_spite_of_outliers(takes):
    """Two views show outliers by one number a joint only; the true noise is 2 px."""
    for seed in (8, 9):
        take = takes(60, 2, 2.0, seed, outlier_share=0.1)
        found = robust(observed(take), frame_axis=0)
        assert float(found.sigma_px[0]) == pytest.approx(2.0, rel=0.4)


def test_bad_shapes_raise(takes):
    take = takes(1, 3, 0.0, 9)
    with pytest.raises(ValueError, match="at least two views"):
        triangulate_robust(Observations(take.uv_px[:, :1], None, take.K[:1], take.T_cam_from_world[:1]))
    with pytest.raises(ValueError, match="3 views, the cameras 2"):
        triangulate_robust(observed(take, K=take.K[:2], T_cam_from_world=take.T_cam_from_world[:2]))


@pytest.mark.parametrize("views", [2, 25, 26, 40, 120])
def test_each_view_is_in_as_many_pairs_as_any_other(views):
    pairs = _pairs(views)
    assert pairs.shape[1] <= MAX_PAIRS
    assert (pairs[0] != pairs[1]).all()
    assert np.ptp(np.bincount(pairs.ravel(), minlength=views)) == 0


def test_outliers_are_found_among_many_cameras(takes):
    take = takes(2, 30, 0.5, 2)
    uv = take.uv_px.copy()
    uv[:, ::3] += 50
    found = robust(observed(take, uv_px=uv), frame_axis=0)
    expected = np.broadcast_to(np.arange(30)[:, None] % 3 > 0, uv.shape[:-1])
    assert (np.asarray(found.inlier_mask) == expected).mean() > 0.99
    assert error_mm(found.points, take).max() < 2
