import subprocess
import sys

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry import cameras
from poem_jax.geometry.cameras import Cameras
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_about_z, rotation_from_axis_angle

HW = (96, 128)


def _project(cams: Cameras, points: np.ndarray) -> np.ndarray:
    return cameras.project(cams.K, cams.T_cam_from_world, points[..., None, :, :])[0]


def test_projection_equals_a_loop(look_at, cloud):
    cams, points = look_at(num_views=2), cloud()
    uv, depth = cameras.project(cams.K, cams.T_cam_from_world, points[None])
    for v in range(2):
        for p in range(len(points)):
            cam = (cams.T_cam_from_world[v] @ [*points[p], 1])[:3]
            u, w = (cams.K[v] @ cam)[:2] / cam[2]
            np.testing.assert_allclose(uv[v, p], [u, w], atol=1e-10)
            np.testing.assert_allclose(depth[v, p], cam[2])


def test_project_then_unproject(look_at, cloud, batch):
    cams, points = look_at(batch), cloud(batch)[..., None, :, :]
    uv, depth = cameras.project(cams.K, cams.T_cam_from_world, points)
    back = cameras.unproject(cams.K, cams.T_cam_from_world, uv, depth)
    np.testing.assert_allclose(back, np.broadcast_to(points, back.shape), atol=1e-12)
    again, _ = cameras.project(cams.K, cams.T_cam_from_world, back)
    np.testing.assert_allclose(again, uv, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_numpy_and_jax_agree_and_keep_their_type(look_at, cloud, batch, dtype, x64):
    cams, points = look_at(batch), cloud(batch)[..., None, :, :].astype(dtype)
    K, T = cams.K.astype(dtype), cams.T_cam_from_world.astype(dtype)

    def everything(K, T, points):
        uv, depth = cameras.project(K, T, points)
        T_rolled, homography = cameras.roll(K, T, 0.3)
        mask = cameras.array_namespace(K).ones(K.shape[:-2], dtype=bool)
        box = K[..., :2, 2].repeat(2, axis=-1) + K[..., 0, 0, None] / 4
        return [
            uv,
            cameras.unproject(K, T, uv, depth),
            cameras.invert_intrinsics(K),
            cameras.crop_intrinsics(K, box, (32, 48)),
            cameras.resize_intrinsics(K, HW, (48, 32)),
            T_rolled,
            cameras.transform_pixels(homography, uv),
            cameras.index_homography(homography),
            *cameras.anchor_to_primary(T, mask),
            cameras.mirror_world(T),
            cameras.mirror_intrinsics(K, 128),
            cameras.mirror_points(points),
            cameras.mirror_pixels(uv, 128),
        ]

    expected = everything(K, T, points)
    for result, wanted in zip(jax.jit(everything)(K, T, points), expected, strict=True):
        assert isinstance(wanted, np.ndarray)
        assert wanted.dtype == result.dtype == dtype
        np.testing.assert_allclose(result, wanted, rtol=2e-4 if dtype == np.float32 else 1e-10, atol=1e-4)


def test_with_and_without_jit_agree(look_at, cloud):
    cams, points = look_at(num_views=2), cloud()
    args = [jnp.asarray(a, jnp.float32) for a in (cams.K, cams.T_cam_from_world, points[None])]
    for eager, jitted in zip(cameras.project(*args), jax.jit(cameras.project)(*args), strict=True):
        np.testing.assert_allclose(eager, jitted, rtol=1e-5)
    stacked = jax.jit(jax.vmap(cameras.project, in_axes=(0, 0, None)))(*args[:2], args[2][0])
    np.testing.assert_allclose(stacked[0], jax.jit(cameras.project)(*args)[0], rtol=1e-5)


def test_gradients_equal_finite_differences(look_at, cloud, check_gradients):
    cams, points = look_at(num_views=2), cloud()[None]
    check_gradients(lambda *a: cameras.project(*a)[0], cams.K, cams.T_cam_from_world, points)
    uv, depth = cameras.project(cams.K, cams.T_cam_from_world, points)
    check_gradients(cameras.unproject, cams.K, cams.T_cam_from_world, uv, depth)
    mask = np.ones(2, bool)
    check_gradients(lambda T: cameras.anchor_to_primary(T, mask)[0], cams.T_cam_from_world)


@pytest.mark.parametrize("z", [0.0, 1e-30, -1e-30, 1e-5, -1e-5, -0.3])
def test_finite_at_and_behind_the_plane_of_the_camera(look_at, z):
    K = look_at(num_views=1).K[0].astype(np.float32)
    points = np.asarray([[0.1, -0.2, z], [0.0, 0.0, z]], np.float32)

    def loss(points):
        uv, depth = cameras.project(K, np.eye(4, dtype=np.float32), points)
        return jnp.sum(uv**2), (uv, depth)

    gradient, (uv, depth) = jax.jit(jax.grad(loss, has_aux=True))(points)
    assert np.isfinite(uv).all()
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(depth, points[:, 2])


def test_crop_commutes_with_projection(look_at, cloud, batch, rng):
    cams, points = look_at(batch), cloud(batch)
    start = rng.uniform(-30, 60, (*cams.K.shape[:-2], 2))
    box = np.concatenate([start, start + rng.uniform(20, 60, start.shape)], axis=-1)
    K_crop = cameras.crop_intrinsics(cams.K, box, (64, 48))
    expected = (_project(cams, points) - box[..., None, :2]) / (box[..., 2:] - box[..., :2])[..., None, :]
    cropped = _project(cams._replace(K=K_crop), points)
    np.testing.assert_allclose(cropped, expected * [48, 64], atol=1e-9)
    homography = cameras.crop_homography(box, (64, 48))
    np.testing.assert_allclose(
        cameras.transform_pixels(homography, _project(cams, points)), cropped, atol=1e-9
    )


def test_box_without_extent_stays_finite():
    assert np.isfinite(cameras.crop_homography(np.zeros((2, 4)), (8, 8))).all()


def test_resize_commutes_with_projection(look_at, cloud):
    cams, points = look_at(), cloud()
    resized = cams._replace(K=cameras.resize_intrinsics(cams.K, HW, (24, 64)))
    np.testing.assert_allclose(_project(resized, points), _project(cams, points) * [0.5, 0.25], atol=1e-10)


def test_roll_commutes_with_projection(look_at, cloud, batch, rng):
    cams, points = look_at(batch), cloud(batch)
    angle = rng.uniform(-np.pi, np.pi, cams.K.shape[:-2])
    T_rolled, homography = cameras.roll(cams.K, cams.T_cam_from_world, angle)
    rolled = _project(cams._replace(T_cam_from_world=T_rolled), points)
    np.testing.assert_allclose(
        rolled, cameras.transform_pixels(homography, _project(cams, points)), atol=1e-9
    )
    # A quarter turn takes what is right of the principal point to below it.
    K = np.asarray([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
    _, quarter = cameras.roll(K, np.eye(4), np.pi / 2)
    np.testing.assert_allclose(cameras.transform_pixels(quarter, np.asarray([[74.0, 48]])), [[64, 58]])


def test_opencv_warps_where_the_index_homography_says(rng):
    K = np.asarray([[110.0, 2, 60], [0, 90, 50], [0, 0, 1]])
    _, homography = cameras.roll(K, np.eye(4), 0.4)
    # A picture of its own coordinates tells where every pixel came from.
    picture = cameras.pixel_centres(HW)
    warped = cv2.warpPerspective(
        picture, cameras.index_homography(homography), HW[::-1], borderValue=(np.nan, np.nan)
    )
    came_from = cameras.transform_pixels(np.linalg.inv(homography), picture.reshape(-1, 2).astype(float))
    inside = np.isfinite(warped).all(-1).ravel()
    assert inside.sum() > 5000
    # OpenCV interpolates at 1/32 of a pixel.
    np.testing.assert_allclose(warped.reshape(-1, 2)[inside], came_from[inside], atol=0.06)


def test_primary_view_is_the_first_valid_one():
    mask = np.asarray([[False, True, True], [True, False, True], [False, False, False]])
    np.testing.assert_array_equal(cameras.primary_view(mask), [1, 0, 0])
    np.testing.assert_array_equal(cameras.primary_view(jnp.asarray(mask)), [1, 0, 0])


def test_anchoring_makes_the_primary_camera_the_world(look_at, cloud, batch, rng):
    cams, points = look_at(batch), cloud(batch)
    mask = np.ones(cams.K.shape[:-2], bool)
    mask[..., 0] = False
    cams.T_cam_from_world[..., 0, :, :] = np.nan
    T_cam_from_primary, T_primary_from_world = cameras.anchor_to_primary(cams.T_cam_from_world, mask)
    np.testing.assert_array_equal(
        T_cam_from_primary[..., :2, :, :], np.broadcast_to(np.eye(4), T_cam_from_primary[..., :2, :, :].shape)
    )
    np.testing.assert_array_equal(T_primary_from_world, cams.T_cam_from_world[..., 1, :, :])
    points_primary = cameras.transform_points(T_primary_from_world, points)
    anchored = _project(cams._replace(T_cam_from_world=T_cam_from_primary), points_primary)
    np.testing.assert_allclose(anchored[..., 1:, :, :], _project(cams, points)[..., 1:, :, :], atol=1e-9)
    # Another world frame gives the same anchored cameras.
    T_world_from_other = rigid(rotation_from_axis_angle(rng.normal(size=3)), rng.normal(size=3))
    moved, _ = cameras.anchor_to_primary(cams.T_cam_from_world @ T_world_from_other, mask)
    np.testing.assert_allclose(moved, T_cam_from_primary, atol=1e-12)


def test_no_valid_view_anchors_to_the_world():
    T = np.full((2, 4, 4), np.nan)
    T_cam_from_primary, T_primary_from_world = cameras.anchor_to_primary(T, np.zeros(2, bool))
    np.testing.assert_array_equal(T_cam_from_primary, np.broadcast_to(np.eye(4), (2, 4, 4)))
    np.testing.assert_array_equal(T_primary_from_world, np.eye(4))


def test_mirroring_commutes_with_projection(look_at, cloud, batch):
    cams, points = look_at(batch), cloud(batch)
    T, T_primary_from_world = cameras.anchor_to_primary(cams.T_cam_from_world, cams.view_mask)
    points_primary = cameras.transform_points(T_primary_from_world, points)
    uv = _project(cams._replace(T_cam_from_world=T), points_primary)
    mirrored_cams = Cameras(cameras.mirror_intrinsics(cams.K, HW[1]), cameras.mirror_world(T))
    mirrored = _project(mirrored_cams, cameras.mirror_points(points_primary))
    np.testing.assert_allclose(mirrored, cameras.mirror_pixels(uv, HW[1]), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(mirrored_cams.T_cam_from_world), 1)
    np.testing.assert_allclose(cameras.mirror_intrinsics(mirrored_cams.K, HW[1]), cams.K, atol=1e-12)
    np.testing.assert_allclose(cameras.mirror_points(cameras.mirror_points(points)), points)


def test_flipping_an_image_is_mirroring_its_pixels():
    centres = cameras.pixel_centres(HW)
    np.testing.assert_allclose(cameras.mirror_pixels(centres, HW[1])[:, ::-1], centres)


def test_masked_views_are_filled(look_at):
    cams = look_at(num_views=3)
    mask = np.asarray([True, False, True])
    cams.K[1], cams.T_cam_from_world[1] = np.nan, np.inf
    filled = cameras.fill_masked_views(Cameras(cams.K, cams.T_cam_from_world, mask))
    np.testing.assert_array_equal(filled.K[1], np.eye(3))
    np.testing.assert_array_equal(filled.T_cam_from_world[1], np.eye(4))
    np.testing.assert_array_equal(filled.K[::2], cams.K[::2])


def test_cameras_are_a_pytree(look_at):
    cams = look_at((2,), num_views=3)
    assert cams.view_mask.shape == (2, 3)
    assert cams.view_mask.all()
    assert isinstance(jax.tree.map(lambda x: None, cams), Cameras)
    assert isinstance(jax.eval_shape(lambda c: c, cams), Cameras)
    stepped = jax.jit(jax.vmap(lambda c: c._replace(K=2 * c.K)))(cams)
    np.testing.assert_allclose(stepped.K, 2 * cams.K, rtol=1e-6)


def test_rotating_about_the_axis_is_the_extrinsic_of_roll():
    T_rolled, _ = cameras.roll(np.eye(3), np.eye(4), 0.2)
    np.testing.assert_allclose(T_rolled[:3, :3], rotation_about_z(0.2))
    np.testing.assert_allclose(invert_rigid(T_rolled)[:3, :3], rotation_about_z(-0.2))


def test_needs_no_jax():
    modules = ("transforms", "cameras", "rig", "alignment", "distortion", "camera_checks")
    imports = ", ".join(f"poem_jax.geometry.{module}" for module in modules)
    code = f"import sys, {imports}; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
