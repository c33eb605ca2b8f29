"""Pictures through every lens are where OpenCV puts them, and what a lens does not show is black."""

import cv2
import numpy as np
import pytest

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.data.lens import picture_map, project_raw, take_picture
from poem_jax.geometry.transforms import rotation_from_axis_angle
from tests.calibration.rigs_of_all_lenses import EIGHT, FISHEYE, FIVE, FOURTEEN, NO_LENS, TWELVE, ring_of

K = np.array([[300.0, 0, 322.3], [0, 303, 238.8], [0, 0, 1]])
K_PICTURE = np.array([[150.0, 0, 82], [0, 155, 61], [0, 0, 1]])
HW = (120, 160)


@pytest.mark.parametrize("dist", [FIVE, EIGHT, TWELVE, FOURTEEN, FISHEYE], ids=len)
@pytest.mark.parametrize("turned", [False, True])
def test_maps_of_pictures_agree_with_opencv(dist, turned):
    R = rotation_from_axis_angle(np.array([0.2, -0.3, 0.1])) if turned else np.eye(3)
    where = picture_map(K, dist, K_PICTURE, HW, 1.0, R if turned else None)
    centres = [np.array(matrix) for matrix in (K, K_PICTURE)]
    for matrix in centres:
        matrix[:2, 2] -= 0.5
    if dist is FISHEYE:
        columns, rows = cv2.fisheye.initUndistortRectifyMap(
            centres[0], dist[:4], R.T, centres[1], HW[::-1], cv2.CV_32FC1
        )
    else:
        columns, rows = cv2.initUndistortRectifyMap(centres[0], dist, R.T, centres[1], HW[::-1], cv2.CV_32FC1)
    shown = where.columns > -900
    assert shown.mean() > 0.9
    np.testing.assert_allclose(where.columns[shown], columns[shown], atol=0.01)
    np.testing.assert_allclose(where.rows[shown], rows[shown], atol=0.01)


def test_a_wide_fisheye_shows_nothing_behind_or_far_aside():
    """A picture that looks aside: black from 85 degrees off the axis, white before."""
    white = np.full((900, 900, 3), 255, np.uint8)
    K_wide = np.array([[250.0, 0, 450], [0, 250, 450], [0, 0, 1]])
    aside = np.radians(70)
    R = rotation_from_axis_angle(np.array([0.0, aside, 0.0]))
    picture = take_picture(
        white,
        picture_map(K_wide, FISHEYE, np.array([[100.0, 0, 100], [0, 100, 20], [0, 0, 1]]), (40, 200), 1.0, R),
    )
    angle = np.degrees(aside + np.arctan((np.arange(200) + 0.5 - 100) / 100))
    assert (picture[20, angle < 82] == 255).all()
    assert not picture[20, angle > 88].any()


def test_a_hand_beyond_the_widest_angle_counts_as_unseen():
    rig = ring_of(FISHEYE, NO_LENS)
    T_world_from_cam = np.linalg.inv(rig.T_cam_from_world[0])
    angles = np.radians([0.0, 40, 80, 84, 86, 89, 95, 130])
    points_cam = np.stack([np.sin(angles), 0 * angles, np.cos(angles), np.ones(8)], -1)
    pixels, _ = project_raw(rig, 0, (points_cam @ T_world_from_cam.T)[:, :3])
    np.testing.assert_array_equal(np.isfinite(pixels).all(-1), angles < np.radians(85))
    theta_d = angles * (1 + 0.05 * angles**2 - 0.02 * angles**4 + 0.004 * angles**6 - 0.001 * angles**8)
    raw = np.full((1, 1, 2, 21, 2), np.nan)
    raw[0, 0, 0, :8] = rig.K[0, :2, 2]
    raw[0, 0, 0, :8, 0] += rig.K[0, 0, 0] * theta_d
    seen = np.isfinite(ideal_keypoints(rig, raw)[0, 0, 0, :6]).all(-1)
    np.testing.assert_array_equal(seen, angles[:6] < np.radians(85))


@pytest.mark.parametrize("lens", [FISHEYE, FOURTEEN], ids=["fisheye", "tilted"])
def test_ideal_key_points_are_those_of_the_pinhole(lens):
    rig = ring_of(lens, FIVE)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (21, 3))
    raw = np.stack([project_raw(rig, view, points)[0] for view in range(2)])[None, None]
    ideal = ideal_keypoints(rig, raw)[0, 0]
    for view in range(2):
        plain = rig._replace(dist=np.zeros((2, 5)))
        np.testing.assert_allclose(ideal[view], project_raw(plain, view, points)[0], atol=1e-6)
