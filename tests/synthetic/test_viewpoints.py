import numpy as np
import pytest

from poem_jax.geometry.cameras import project
from poem_jax.synthetic.config import CameraConfig, CropConfig
from poem_jax.synthetic.viewpoints import directions_on_sphere, draw_viewpoints

JOINTS = np.random.default_rng(0).normal(size=(21, 3)) * 0.05 + [0.4, -0.2, 0.7]


def draw(num_views, seed=0, cameras=None, crop=None):
    rng = np.random.default_rng(seed)
    return draw_viewpoints(cameras or CameraConfig(), crop or CropConfig(), rng, JOINTS, num_views, (128, 96))


def test_first_views_do_not_depend_on_how_many_follow():
    for few, many in zip(draw(3), draw(8), strict=True):
        np.testing.assert_array_equal(few, many[:3])


def test_the_box_of_the_joints_fills_its_share_of_the_crop():
    crop = CropConfig(expand_ratio=2.0, center_jitter=0.0, scale_jitter=0.0)
    at = draw_viewpoints(CameraConfig(), crop, np.random.default_rng(1), JOINTS, 20, (100, 100))
    uv, depth = project(at.K_crop, at.T_cam_from_world, np.broadcast_to(JOINTS, (20, 21, 3)))
    assert depth.min() > 0
    low, high = uv.min(1), uv.max(1)
    np.testing.assert_allclose((high - low).max(-1), 50, rtol=1e-9)
    np.testing.assert_allclose((low + high) / 2, 50, rtol=1e-9)


def test_crop_and_frame_see_the_same():
    at = draw(50)
    joints = np.broadcast_to(JOINTS, (50, 21, 3))
    full = project(at.K_frame, at.T_cam_from_world, joints)[0]
    crop = project(at.K_crop, at.T_cam_from_world, joints)[0]
    start, end = at.frame_in_crop[:, None, :2], at.frame_in_crop[:, None, 2:]
    np.testing.assert_allclose(start + full / at.frame_wh[:, None] * (end - start), crop, atol=1e-6)


def test_cameras_see_the_hand_within_the_aimed_part_of_the_frame():
    at = draw(200, cameras=CameraConfig(aim_jitter=0.25, principal_sigma=0.0))
    center = np.broadcast_to(JOINTS.mean(0), (200, 1, 3))
    uv = project(at.K_frame, at.T_cam_from_world, center)[0][:, 0] / at.frame_wh
    assert uv.min() >= 0.375 - 1e-9
    assert uv.max() <= 0.625 + 1e-9
    assert np.ptp(uv, axis=0).min() > 0.2


def test_optical_centres_and_distances():
    at = draw(50, cameras=CameraConfig(distance_m=(0.5, 0.6)))
    R, t = at.T_cam_from_world[:, :3, :3], at.T_cam_from_world[:, :3, 3]
    np.testing.assert_allclose(-np.einsum("vji,vj->vi", R, t), at.camera_world, atol=1e-12)
    gaps = np.linalg.norm(at.camera_world - JOINTS.mean(0), axis=-1)
    assert 0.5 <= gaps.min() <= gaps.max() <= 0.6


@pytest.mark.parametrize("batch", [(), (1,), (3, 2)])
def test_directions_have_length_one(batch):
    u, v = np.random.default_rng(0).random((2, *batch))
    np.testing.assert_allclose(np.linalg.norm(directions_on_sphere(u, v), axis=-1), np.ones(batch))


def test_directions_are_uniform():
    vectors = directions_on_sphere(*np.random.default_rng(0).random((2, 20000)))
    np.testing.assert_allclose(vectors.mean(0), 0, atol=0.02)
    for axis in range(3):
        shares = np.histogram(vectors[:, axis], bins=5, range=(-1, 1))[0] / 20000
        np.testing.assert_allclose(shares, 0.2, atol=0.02)
