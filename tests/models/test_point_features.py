import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.cameras import Cameras
from poem_jax.models.config import BasisConfig, BasisSampling
from poem_jax.models.point_features import basis_points, evidence, projected_features


@pytest.mark.parametrize(("sampling", "mean_radius"), [("ball", 0.075), ("gaussian", 0.0655)])
def test_points_fill_the_ball(sampling, mean_radius):
    points = basis_points(BasisConfig(sampling=BasisSampling(sampling)))
    radius = np.linalg.norm(points, axis=-1)
    assert points.shape == (4096, 3)
    assert points.dtype == np.float32
    assert radius.max() <= 0.1
    assert abs(radius.mean() - mean_radius) < 2e-3
    assert np.abs(points.mean(0)).max() < 3e-3


def test_points_are_fixed_by_their_seed():
    np.testing.assert_array_equal(basis_points(BasisConfig()), basis_points(BasisConfig()))
    assert not np.allclose(basis_points(BasisConfig()), basis_points(BasisConfig(seed=1)))


@pytest.fixture
def ramp():
    """A 32 x 32 image's stride-8 map whose channels hold its cell centres' pixels."""
    centres = 8 * (np.arange(4) + 0.5)
    u, v = np.meshgrid(centres, centres)
    maps = np.zeros((1, 1, 4, 4, 8), np.float32)
    maps[0, 0, ..., 0], maps[0, 0, ..., 1] = u, v
    K = np.array([[[[40.0, 0, 16], [0, 40, 16], [0, 0, 1]]]], np.float32)
    return jnp.asarray(maps), Cameras(K, np.eye(4, dtype=np.float32)[None, None])


def test_features_are_read_where_points_project(ramp):
    maps, cams = ramp
    points = np.array([[[0.05, -0.03, 0.5], [0.0, 0.0, 0.4]]], np.float32)
    uv = 40 * points[..., :2] / points[..., 2:] + 16
    features, share = projected_features(maps, cams, points, (32, 32))
    np.testing.assert_allclose(features[0, 0, :, :2], uv[0], atol=1e-4)
    np.testing.assert_allclose(share[0, 0], uv[0] / 32, atol=1e-6)


def test_points_behind_the_camera_read_nothing(ramp):
    maps, cams = ramp
    points = np.array([[[0.0, 0.0, -0.5]]], np.float32)
    features, share = projected_features(maps, cams, points, (32, 32))
    assert not np.any(features)
    assert not np.any(share)


def test_the_release_reads_through_the_camera(ramp):
    """A point behind the camera reads what its mirror image in front reads."""
    maps, cams = ramp
    points = np.array([[[0.05, -0.03, 0.5]]], np.float32)
    front, _ = projected_features(maps, cams, points, (32, 32), zeros_behind=False)
    back, _ = projected_features(maps, cams, -points, (32, 32), zeros_behind=False)
    assert np.any(front)
    np.testing.assert_allclose(front, back, atol=1e-4)


def test_evidence_is_nothing_where_a_map_is_even():
    heat = np.full((1, 3, 4, 4), 1 / 16, np.float32)
    heat[0, 1], heat[0, 1, 2, 3] = 0, 1
    heat[0, 2, 0, 0] = 2 / 16
    seen = np.asarray(evidence(jnp.asarray(heat)))
    assert seen.shape == (1, 4, 4, 3)
    np.testing.assert_allclose(seen[..., 0], 0, atol=0.01)
    assert np.unravel_index(seen[0, ..., 1].argmax(), (4, 4)) == (2, 3)
    assert np.isfinite(seen).all()
    np.testing.assert_allclose(seen[0, 0, 0, 2] - seen[0, 1, 1, 2], np.log(2) / 4, rtol=0.01)
