"""Lenses of every model against OpenCV, and rigs that mix them."""

import cv2
import jax
import numpy as np
import pytest

from poem_jax.geometry import distortion
from poem_jax.geometry.distortion import WIDEST_ANGLE, fisheye_lens, shortest_terms, stack_lenses
from tests.calibration.rigs_of_all_lenses import (
    EIGHT,
    FISHEYE,
    FIVE,
    FOUR,
    FOURTEEN,
    NO_LENS,
    TWELVE,
    ring_of,
)

K = np.array([[900.0, 0, 620], [0, 905, 395], [0, 0, 1]])
PINHOLES = [FOUR, FIVE, EIGHT, TWELVE, FOURTEEN]
BARREL = fisheye_lens(np.array([-0.03, 0.01, -0.004, 0.0005]))
EQUIDISTANT = fisheye_lens(np.zeros(4))
MIXED = stack_lenses([FIVE, FISHEYE, NO_LENS, EIGHT, TWELVE, FOURTEEN, BARREL])


def some_rays(rng, widest=0.5, count=60):
    return rng.uniform(-widest, widest, (count, 2))


def pixels(points):
    return points * [K[0, 0], K[1, 1]] + K[:2, 2]


@pytest.mark.parametrize("dist", PINHOLES, ids=len)
def test_pinholes_equal_opencv(rng, dist):
    rays = some_rays(rng)
    expected, _ = cv2.projectPoints(
        np.pad(rays, ((0, 0), (0, 1)), constant_values=1), np.zeros(3), np.zeros(3), K, dist
    )
    np.testing.assert_allclose(distortion.distort_pixels(pixels(rays), K, dist), expected[:, 0], atol=1e-8)
    back = distortion.undistort_pixels(expected[:, 0], K, dist)
    np.testing.assert_allclose(back, pixels(rays), atol=1e-8)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    theirs = cv2.undistortImagePoints(expected, K, dist, None, until)
    np.testing.assert_allclose(back, theirs[:, 0], atol=0.01)


@pytest.mark.parametrize("dist", [FISHEYE, BARREL, EQUIDISTANT], ids=["measured", "barrel", "equidistant"])
def test_fisheyes_equal_opencv(rng, dist):
    angle, turn = rng.uniform(0, 1.4, 200), rng.uniform(0, 2 * np.pi, 200)
    rays = np.tan(angle)[:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    points = np.pad(rays, ((0, 0), (0, 1)), constant_values=1)[:, None]
    expected, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K, dist[:4])
    got = pixels(distortion.distort(rays, dist))
    np.testing.assert_allclose(got, expected[:, 0], atol=1e-8)
    back = distortion.undistort(distortion.distort(rays, dist), dist)
    np.testing.assert_allclose(back, rays, rtol=1e-9, atol=1e-9)
    theirs = cv2.fisheye.undistortPoints(expected, K, dist[:4], P=np.eye(3))[:, 0]
    near = angle < 1.2
    np.testing.assert_allclose(pixels(back[near]), pixels(theirs[near]), atol=0.01)


def test_a_rig_of_mixed_lenses_is_each_of_them(rng, x64):
    points = some_rays(rng, count=len(MIXED) * 9).reshape(len(MIXED), 9, 2)
    together = distortion.distort(points, MIXED)
    alone = [
        distortion.distort(p, dist)
        for p, dist in zip(points, (FIVE, FISHEYE, NO_LENS, EIGHT, TWELVE, FOURTEEN, BARREL), strict=True)
    ]
    np.testing.assert_allclose(together, np.stack(alone), atol=1e-14)
    np.testing.assert_allclose(distortion.undistort(together, MIXED), points, atol=1e-12)
    there_and_back = jax.jit(lambda p, d: distortion.undistort(distortion.distort(p, d), d))
    np.testing.assert_allclose(there_and_back(points, MIXED), points, atol=1e-12)
    single = there_and_back(points.astype(np.float32), MIXED.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, points, atol=3e-6)


@pytest.mark.slow
def test_gradients_equal_finite_differences(rng, check_gradients):
    """There and back at once, as each is the other's inverse, with another lens on the way back."""
    lenses = stack_lenses([FISHEYE, FOURTEEN])
    points = some_rays(rng, count=6).reshape(2, 3, 2)
    points[0, 0] = 0.01, -0.02
    check_gradients(
        lambda p, d: distortion.undistort(distortion.distort(p, lenses), d), points, 0.99 * lenses
    )


def test_the_axis_and_far_beyond_it_are_finite_as_are_their_gradients():
    points = np.array([[0.0, 0.0], [1e3, -1e4], [3.0, 2.0]])

    def there_and_back(p):
        return distortion.distort(p, FISHEYE), distortion.undistort(p, FISHEYE)

    values, slopes = jax.jit(lambda p: (there_and_back(p), jax.jacobian(there_and_back)(p)))(points)
    for value, slope in zip(values, slopes, strict=True):
        assert np.isfinite(value).all()
        assert np.isfinite(slope).all()
        np.testing.assert_array_equal(value[0], 0)
        np.testing.assert_allclose(slope[0, :, 0], np.eye(2), atol=1e-6)


def test_what_no_flat_picture_shows_is_not_brought_back():
    """Rays beyond the widest angle, as those behind the camera, fail the round trip."""
    for angle in (WIDEST_ANGLE + 0.01, np.radians(89), np.radians(95), np.radians(110)):
        image = np.array([[angle * (1 + 0.05 * angle**2), 0.0]])
        lens = fisheye_lens(np.array([0.05, 0, 0, 0]))
        back = distortion.distort(distortion.undistort(image, lens), lens)
        assert np.linalg.norm(back - image) > 5e-3
    inside = np.array([[1.3, 0.0]])
    np.testing.assert_allclose(
        distortion.distort(distortion.undistort(inside, EQUIDISTANT), EQUIDISTANT), inside
    )


def test_a_rig_says_which_cameras_are_fisheyes():
    rig = ring_of(FIVE, FISHEYE, NO_LENS)
    np.testing.assert_array_equal(rig.fisheye, [False, True, False])
    np.testing.assert_array_equal(rig.select(["cam_1"]).fisheye, [True])
    np.testing.assert_array_equal(ring_of(FIVE, EIGHT).fisheye, [False, False])


def test_the_shortest_terms_are_those_that_tools_write():
    for terms in (FIVE, EIGHT, TWELVE, FOURTEEN):
        np.testing.assert_array_equal(shortest_terms(np.pad(terms, (0, 15 - len(terms)))), terms)
    np.testing.assert_array_equal(shortest_terms(FISHEYE), FISHEYE[:4])
    assert len(shortest_terms(np.zeros(15))) == 5
