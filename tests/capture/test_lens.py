"""Where things land: undistorted crops, raw projections, and the edges of what a lens shows."""

import cv2
import numpy as np
import pytest

from poem_jax.capture.crop import crop_image
from poem_jax.capture.outputs.page import make_gallery
from poem_jax.data.lens import picture_map, project_raw, take_picture
from poem_jax.geometry.cameras import project
from poem_jax.geometry.distortion import undistort_pixels
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle

CROP_HW = (64, 64)


def blob(hw, centre_px, sigma=2.5):
    """A photograph of one soft dot, exact at pixel centres."""
    v, u = np.meshgrid(np.arange(hw[0]) + 0.5, np.arange(hw[1]) + 0.5, indexing="ij")
    value = 255 * np.exp(-((u - centre_px[0]) ** 2 + (v - centre_px[1]) ** 2) / (2 * sigma**2))
    return np.repeat(np.rint(value).astype(np.uint8)[..., None], 3, axis=-1)


def centroid(image):
    weight = image[..., 0].astype(np.float64)
    v, u = np.meshgrid(np.arange(image.shape[0]) + 0.5, np.arange(image.shape[1]) + 0.5, indexing="ij")
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def test_raw_projection_agrees_with_opencv(rig):
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    for view in range(3):
        T, K = rig.T_cam_from_world[view], rig.K[view].copy()
        pixels, points_cam = project_raw(rig, view, points)
        np.testing.assert_allclose(points_cam, points @ T[:3, :3].T + T[:3, 3], atol=1e-12)
        skew, K[0, 1] = K[0, 1], 0  # OpenCV knows no skew
        expected = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, rig.dist[view])[0][
            :, 0
        ]
        expected[:, 0] += skew * (expected[:, 1] - K[1, 2]) / K[1, 1]
        np.testing.assert_allclose(pixels, expected, atol=1e-9)


def test_points_that_the_lens_does_not_show_are_nan(rig):
    T_world_from_cam = np.linalg.inv(rig.T_cam_from_world[0])
    behind_and_beyond = np.array([[0, 0, -0.5, 1], [1.5, 0, 0.5, 1], [0, 0, 0.5, 1]]) @ T_world_from_cam.T
    pixels, _ = project_raw(rig, 0, behind_and_beyond[:, :3])
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], rig.K[0, :2, 2])


@pytest.mark.parametrize("view", [0, 1, 2])
@pytest.mark.parametrize("side_px", [40.0, 90.0, 150.0])
def test_a_3d_point_lands_at_its_pixel_of_the_crop(rig, view, side_px):
    point = np.array([[0.03, -0.04, 0.02]])
    raw_px = project_raw(rig, view, point)[0][0]
    width, height = rig.size_wh[view]
    ideal = undistort_pixels(raw_px[None], rig.K[view], rig.dist[view])[0]
    box = np.array([*(ideal - 0.45 * side_px), *(ideal + 0.55 * side_px)])
    image, K = crop_image(blob((height, width), raw_px), rig, view, box, CROP_HW)
    expected = project(K, rig.T_cam_from_world[view], point)[0][0]
    np.testing.assert_allclose(centroid(image), expected, atol=0.06)


def test_a_picture_with_the_cameras_own_K_and_no_distortion_is_the_photograph(rig):
    image = np.random.default_rng(0).integers(0, 255, (180, 240, 3)).astype(np.uint8)
    same = picture_map(rig.K[2], np.zeros(5), rig.K[2], (180, 240), 1.0)
    np.testing.assert_array_equal(take_picture(image, same), image)


def test_beyond_the_photograph_is_black_and_downscaling_averages(rig):
    image = np.zeros((180, 240, 3), np.uint8)
    image[::2] = 200  # stripes of one pixel: any aliasing shows
    K = rig.K[2]
    small = take_picture(image, picture_map(K, np.zeros(5), K * [[0.25], [0.25], [1]], (45, 60), 4.0))
    assert np.abs(small.astype(int) - 100).max() <= 1
    shifted = K.copy()
    shifted[0, 2] += 240
    assert (take_picture(image, picture_map(K, np.zeros(5), shifted, (180, 240), 1.0)) == 0).all()


def test_beyond_the_fold_of_the_lens_is_black():
    """With k1 = -0.3 the image radius r (1 - 0.3 r^2) turns back at r = 1.05, and shows the scene again."""
    K = np.array([[100.0, 0, 120], [0, 100, 90], [0, 0, 1]])
    K_picture = np.array([[30.0, 0, 60], [0, 30, 60], [0, 0, 1]])
    dist = np.array([-0.3, 0, 0, 0, 0])
    white = np.full((180, 240, 3), 255, np.uint8)
    v, u = np.meshgrid(np.arange(120) + 0.5, np.arange(120) + 0.5, indexing="ij")
    radius = np.hypot(u - 60, v - 60) / 30
    for step in (1.0, 2.5):
        picture = take_picture(white, picture_map(K, dist, K_picture, (120, 120), step))
        assert (picture[radius < 0.8] == 255).all()
        assert (picture[radius > 1.1] == 0).all()


def test_a_turned_picture_shows_points_where_its_pinhole_sees_them(rig):
    point = np.array([[0.05, -0.03, 0.02]])
    K = np.array([[150.0, 0, 60], [0, 150, 50], [0, 0, 1]])
    R = rotation_from_axis_angle(np.array([0.1, -0.2, 0.3]))
    for view in range(3):
        raw_px = project_raw(rig, view, point)[0][0]
        width, height = rig.size_wh[view]
        where = picture_map(rig.K[view], rig.dist[view], K, (100, 120), 1.4, R)
        T_picture_from_world = rigid(R.T, np.zeros(3)) @ rig.T_cam_from_world[view]
        expected = project(K, T_picture_from_world, point)[0][0]
        image = take_picture(blob((height, width), raw_px), where)
        np.testing.assert_allclose(centroid(image), expected, atol=0.06)
    backwards = rotation_from_axis_angle(np.array([0, np.pi, 0.0]))
    behind = picture_map(rig.K[2], np.zeros(5), K, (100, 120), 1.0, backwards)
    assert not take_picture(np.full((180, 240, 3), 255, np.uint8), behind).any()


def test_the_pages_pictures_fill_their_frames(rig):
    """Also where the principal point is far from the middle, as in a picture cut out of a larger one."""
    K = rig.K.copy()
    K[:, 0, 2] += 100
    gallery = make_gallery(rig._replace(K=K, dist=np.zeros((3, 5))), 1)
    white = np.full((180, 240, 3), 255, np.uint8)
    for camera, where in zip(gallery.cameras, gallery.maps, strict=True):
        picture = take_picture(white, where)
        assert picture.shape[:2] == camera.hw == (180, 240)
        assert (picture > 0).all(-1).mean() > 0.88  # 58 % if it looked along the camera's own axis
