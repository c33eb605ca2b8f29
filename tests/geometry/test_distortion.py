import cv2
import jax
import numpy as np
import pytest

from poem_jax.geometry import distortion

DIST = np.asarray(
    [[-0.33, 0.046, -0.0043, 0.0041, 0.066], [0.1, -0.2, 0.001, -0.002, 0.05], [0.0, 0.0, 0.0, 0.0, 0.0]]
)
RATIONAL = np.asarray([0.5, 0.1, 0.001, -0.002, 0.01, 0.6, 0.05, 0.001])
K = np.asarray([[900.0, 0, 620], [0, 905, 395], [0, 0, 1]])


def _points(rng, batch=()):
    return rng.uniform(-0.5, 0.5, (*batch, 9, 2))


@pytest.mark.parametrize("dist", [*DIST, RATIONAL], ids=str)
def test_equals_opencv(rng, dist):
    points = _points(rng)
    rays = np.concatenate([points, np.ones((9, 1))], axis=-1)
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, dist)
    np.testing.assert_allclose(distortion.distort_pixels(_pixels(points), K, dist), expected[:, 0], atol=1e-9)
    back = distortion.undistort_pixels(expected[:, 0], K, dist)
    np.testing.assert_allclose(back, _pixels(points), atol=1e-9)


def _pixels(points):
    return points * [K[0, 0], K[1, 1]] + K[:2, 2]


@pytest.mark.parametrize(("dtype", "atol"), [(np.float32, 1e-6), (np.float64, 1e-13)])
def test_round_trip(rng, batch, dtype, atol, x64):
    points = _points(rng, (*batch, 3)).astype(dtype)
    dist = np.broadcast_to(DIST, (*batch, 3, 5)).astype(dtype)
    back = distortion.undistort(distortion.distort(points, dist), dist)
    assert back.dtype == dtype
    np.testing.assert_allclose(back, points, atol=atol)
    jitted = jax.jit(lambda p, d: distortion.undistort(distortion.distort(p, d), d))(points, dist)
    assert jitted.dtype == dtype
    np.testing.assert_allclose(jitted, points, atol=atol)


def test_pixels_can_change_intrinsics(rng):
    K_new = K + np.asarray([[50, 0, -9], [0, 40, 7], [0, 0, 0]])
    uv = _pixels(_points(rng))
    back = distortion.distort_pixels(distortion.undistort_pixels(uv, K, DIST[0], K_new), K, DIST[0], K_new)
    np.testing.assert_allclose(back, uv, atol=1e-9)


def test_gradients_equal_finite_differences(rng, check_gradients):
    points = _points(rng, (3,))
    check_gradients(distortion.distort, points, DIST)
    check_gradients(distortion.undistort, distortion.distort(points, DIST), DIST)
    check_gradients(distortion.distort, points[0], RATIONAL)
    check_gradients(distortion.undistort, distortion.distort(points[0], RATIONAL), RATIONAL)


def test_five_terms_are_eight_of_which_the_last_are_zero(rng):
    points = _points(rng, (3,))
    longer = np.pad(DIST, ((0, 0), (0, 3)))
    np.testing.assert_array_equal(distortion.distort(points, longer), distortion.distort(points, DIST))


def test_beyond_the_fold_stays_finite():
    points = np.asarray([[3.0, -2.0], [100.0, 0.0], [0.0, 0.0]])
    strong = np.asarray([-0.4, 0.0, 0.0, 0.0, 0.0])
    assert np.isfinite(distortion.undistort(points, strong)).all()
    assert np.isfinite(jax.jit(jax.jacobian(distortion.undistort))(points, strong)).all()
