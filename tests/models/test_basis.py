import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.cameras import Cameras
from poem_jax.models.basis import basis_points, projected_features, sine_code
from poem_jax.models.config import BasisConfig, BasisSampling


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


def test_sine_code_is_the_written_formula():
    width, uv = 16, np.array([[0.25, 0.75], [-0.5, 1.5]], np.float32)
    expected = np.zeros((2, width))
    for n, (u, v) in enumerate(uv):
        for axis, share in enumerate((v, u)):
            for i in range(width // 4):
                angle = 2 * np.pi * share / 10000 ** (2 * i / (width // 2))
                expected[n, axis * width // 2 + 2 * i] = np.sin(angle)
                expected[n, axis * width // 2 + 2 * i + 1] = np.cos(angle)
    np.testing.assert_allclose(sine_code(jnp.asarray(uv), width), expected, atol=1e-6)


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
    features = projected_features(maps, cams, points, (32, 32)) - sine_code(jnp.asarray(uv / 32), 8)[:, None]
    np.testing.assert_allclose(features[0, 0, :, :2], uv[0], atol=1e-4)


def test_points_behind_the_camera_read_nothing(ramp):
    maps, cams = ramp
    points = np.array([[[0.0, 0.0, -0.5]]], np.float32)
    features = projected_features(maps, cams, points, (32, 32))
    np.testing.assert_allclose(features[0, 0, 0], sine_code(jnp.zeros(2), 8), atol=1e-6)
