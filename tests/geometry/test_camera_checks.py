import jax
import numpy as np
import pytest

from poem_jax.geometry.camera_checks import check_cameras
from poem_jax.geometry.cameras import Cameras, crop_intrinsics, project, roll
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle

HW = (96, 128)


@pytest.fixture
def cams(look_at) -> Cameras:
    return look_at((2,), num_views=4)


def _refused(cams: Cameras, match: str, root_world: np.ndarray | None = None) -> None:
    with pytest.raises(ValueError, match=match):
        check_cameras(cams, HW, root_world)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_good_cameras_pass_in_any_world(cams, rng, dtype):
    for _ in range(5):
        T_world_from_other = rigid(rotation_from_axis_angle(rng.normal(size=3)), 30 * rng.normal(size=3))
        moved = cams.T_cam_from_world @ T_world_from_other
        check_cameras(Cameras(cams.K.astype(dtype), moved.astype(dtype)), HW)


def test_rolled_crops_far_from_the_axis_pass(look_at, rng):
    for num_views in (1, 2, 4, 8):
        cams = look_at((6,), num_views)
        root = rng.uniform(-0.3, 0.3, (6, 3))
        T, _ = roll(cams.K, cams.T_cam_from_world, rng.uniform(-3, 3, cams.K.shape[:-2]))
        (uv, depth) = project(cams.K, T, root[:, None, None, :])
        half = 0.1 * cams.K[..., :1, 0] / np.abs(depth)
        box = np.concatenate([uv[..., 0, :] - half, uv[..., 0, :] + half], axis=-1)
        K = crop_intrinsics(cams.K, box, HW)
        outside = np.maximum(-K[..., :2, 2], K[..., :2, 2] - HW[::-1]) / HW[::-1]
        assert outside.max() > 1, "the case is meant to have principal points far outside"
        mask = depth[..., 0] > 0.05
        check_cameras(Cameras(K, T, mask), HW)
        check_cameras(Cameras(K, T, mask), HW, root)


def test_masked_views_may_hold_anything(cams):
    mask = np.ones((2, 4), bool)
    mask[0, 2] = mask[1, :] = False
    cams.K[~mask], cams.T_cam_from_world[~mask] = np.nan, np.inf
    check_cameras(cams._replace(view_mask=mask), HW)


def test_shapes(cams):
    K, T, mask = cams
    _refused(
        Cameras(K[..., :2, :], T, mask), r"`K` must have shape \(\*batch, view, 3, 3\); got \(2, 4, 2, 3\)"
    )
    _refused(
        Cameras(K, T[:, :3], mask),
        r"`T_cam_from_world` must have shape .* = \(2, 4, 4, 4\).*got \(2, 3, 4, 4\)",
    )
    _refused(Cameras(K, T[..., :3, :], mask), r"`T_cam_from_world` must have shape .*got \(2, 4, 3, 4\)")
    _refused(Cameras(K, T, mask.T), r"`view_mask` must have shape \(\*batch, view\) = \(2, 4\).*got \(4, 2\)")
    _refused(cams, r"`root_world` must have shape \(\*batch, 3\) = \(2, 3\).*got \(3,\)", np.zeros(3))


def test_shapes_are_checked_under_a_trace(cams):
    with pytest.raises(ValueError, match=r"`view_mask` must have shape"):
        jax.eval_shape(lambda c: check_cameras(c, HW), Cameras(*cams[:2], cams.view_mask.T))
    # Values are not: they are not there.
    cams.K[...] = np.nan
    jax.jit(lambda c: check_cameras(c, HW))(cams)


def test_lists_and_no_views(cams):
    K, T, mask = cams
    _refused(Cameras(K.tolist(), T, mask), r"`K` must be an array; got list: pass np\.asarray")
    _refused(Cameras(K, T.tolist(), mask), r"`T_cam_from_world` must be an array; got list")
    _refused(cams, "`root_world` must be an array; got list", [[0.0, 0, 0]] * 2)
    _refused(Cameras(K[:, :0], T[:, :0], mask[:, :0]), r"at least one view; got `K` of shape \(2, 0, 3, 3\)")


def test_dtypes(cams):
    K, T, mask = cams
    _refused(Cameras(K.astype(int), T, mask), "`K` must be floating point; got int64")
    _refused(Cameras(K, T.astype(int), mask), "`T_cam_from_world` must be floating point; got int64")
    _refused(Cameras(K, T, mask.astype(float)), "`view_mask` must be bool, True = valid; got float64")


def test_not_finite(cams):
    cams.T_cam_from_world[1, 2, 0, 3] = np.inf
    _refused(cams, r"`T_cam_from_world` must be finite; got .*inf.* at index \(1, 2\); mask views")
    cams.K[0, 3, 0, 0] = np.nan
    _refused(cams, r"`K` must be finite; got .*nan.* at index \(0, 3\); mask views")


def test_form_of_intrinsics(cams):
    form = r"`K` must be \[\[fx, s, cx\], \[0, fy, cy\], \[0, 0, 1\]\]"
    _refused(cams._replace(K=np.swapaxes(cams.K, -1, -2)), form)
    _refused(cams._replace(K=2 * cams.K), form)
    flipped = cams.K.copy()
    flipped[0, 1, 0, 0] *= -1
    _refused(cams._replace(K=flipped), r"focal lengths of `K` must be positive; got \[-.* at index \(0, 1\)")
    normalised = cams.K / np.asarray([[HW[1]], [HW[0]], [1]])
    _refused(
        cams._replace(K=normalised), r"in pixels of the image as fed .*\(96, 128\).*they look normalised"
    )


def test_form_of_extrinsics(cams):
    T = cams.T_cam_from_world
    _refused(cams._replace(T_cam_from_world=np.swapaxes(T, -1, -2)), r"last row .* must be \(0, 0, 0, 1\)")
    scaled = T.copy()
    scaled[1, 0, :3, :3] *= 1.1
    _refused(cams._replace(T_cam_from_world=scaled), r"must be orthonormal.*at index \(1, 0\)")
    singular = T.copy()
    singular[0, 1, 0, :3] = singular[0, 1, 1, :3]
    _refused(cams._replace(T_cam_from_world=singular), r"must be orthonormal.*at index \(0, 1\)")
    reflected = T * np.asarray([-1, 1, 1, 1])
    _refused(cams._replace(T_cam_from_world=reflected), r"det R = 1; got -1.* it is a reflection")


@pytest.mark.parametrize("num_views", [2, 3, 8])
def test_millimetres(look_at, num_views):
    cams = look_at((2,), num_views)
    cams.T_cam_from_world[..., :3, 3] *= 1000
    _refused(cams, "cameras must be within 20 m of each other; got .*divide its last column by 1000")


@pytest.mark.parametrize("num_views", [3, 4, 8])
def test_inverted_extrinsics(look_at, num_views):
    cams = look_at((2,), num_views)
    # A world frame beside the hand, as rigs have; about the hand itself the two may look alike.
    R, t = rotation_from_axis_angle(np.asarray([0.5, -1, 0.3])), np.asarray([0.3, 0.2, 0.5])
    T = cams.T_cam_from_world @ rigid(R, t)
    check_cameras(cams._replace(T_cam_from_world=T), HW)
    match = "must map world points to camera points.*pass the inverses"
    _refused(cams._replace(T_cam_from_world=invert_rigid(T)), match)


def test_intrinsics_of_another_resolution(look_at):
    match = r"`K` must belong to the image as fed, \(h, w\) = \(96, 128\); its principal point is far outside"
    scale = np.asarray([[10.0], [10.0], [1.0]])
    for num_views in (2, 4, 8):
        cams = look_at((2,), num_views)
        _refused(cams._replace(K=cams.K * scale), match)
    one = look_at((2,), 1)
    _refused(one._replace(K=one.K * scale), match, np.zeros((2, 3)))
    away = one.K.copy()
    away[..., 0, 2] = -2000
    _refused(one._replace(K=away), match)
