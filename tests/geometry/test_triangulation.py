import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.camera_checks import check_cameras
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle, transform_points
from poem_jax.geometry.triangulation import null_vector, triangulate

triangulate_jit = jax.jit(triangulate, static_argnames="normalise_rows")


def _seen(look_at, cloud, batch=(), num_views=4, num_points=5):
    cams, points = look_at(batch, num_views), cloud(batch, num_points)
    uv, _ = project(cams.K, cams.T_cam_from_world, points[..., None, :, :])
    return cams, points, uv


def _naive(uv, K, T, normalise_rows):
    """One point, by the textbook."""
    rows = []
    for (u, v), k, t in zip(uv, K, T, strict=True):
        M = k @ t[:3]
        rows += [u * M[2] - M[0], v * M[2] - M[1]]
    if normalise_rows:
        rows = [row / np.linalg.norm(row) for row in rows]
    x = np.linalg.svd(np.asarray(rows))[2][-1]
    return x[:3] / x[3] if normalise_rows else x[:3] / (x[3] + 1e-7)


@pytest.mark.parametrize("normalise_rows", [True, False])
def test_recovers_projected_points(look_at, cloud, batch, x64, normalise_rows):
    cams, points, uv = _seen(look_at, cloud, batch)
    found, valid = triangulate_jit(uv, cams.K, cams.T_cam_from_world, normalise_rows=normalise_rows)
    assert np.all(valid)
    assert found.shape == points.shape
    np.testing.assert_allclose(found, points, atol=1e-9 if normalise_rows else 1e-6)


@pytest.mark.parametrize("normalise_rows", [True, False])
def test_equals_the_naive_form_on_noisy_pixels(look_at, cloud, rng, x64, normalise_rows):
    cams, _, uv = _seen(look_at, cloud, num_views=3)
    uv = uv + rng.normal(size=uv.shape) * 2
    found, _ = triangulate_jit(uv, cams.K, cams.T_cam_from_world, normalise_rows=normalise_rows)
    for i in range(uv.shape[-2]):
        expected = _naive(uv[:, i], cams.K, cams.T_cam_from_world, normalise_rows)
        # The sign of the singular vector is free, and the release adds 1e-7 to its fourth component.
        np.testing.assert_allclose(found[i], expected, atol=1e-9 if normalise_rows else 1e-6)


@pytest.mark.parametrize("normalise_rows", [True, False])
def test_float32(look_at, cloud, normalise_rows):
    cams, points, uv = _seen(look_at, cloud, (4,), num_views=3)
    args = [a.astype(np.float32) for a in (uv, cams.K, cams.T_cam_from_world)]
    found, valid = triangulate_jit(*args, normalise_rows=normalise_rows)
    assert found.dtype == np.float32
    assert np.all(valid)
    np.testing.assert_allclose(found, points, atol=2e-6)


def test_jit_eager_and_vmap_agree(look_at, cloud):
    cams, _, uv = _seen(look_at, cloud, (2,), num_views=2)
    args = [jnp.asarray(a, jnp.float32) for a in (uv, cams.K, cams.T_cam_from_world)]
    expected = triangulate_jit(*args)[0]
    np.testing.assert_allclose(triangulate(*args)[0], expected, atol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.vmap(triangulate))(*args)[0], expected, atol=1e-5)


def test_masked_views_change_nothing_whatever_they_hold(look_at, cloud, rng, x64):
    cams, _, uv = _seen(look_at, cloud, num_views=2)
    uv = uv + rng.normal(size=uv.shape)
    expected, _ = triangulate_jit(uv, cams.K, cams.T_cam_from_world)
    nan = [np.concatenate([a, np.full((2, *a.shape[1:]), np.nan)]) for a in (uv, *cams[:2])]
    mask = np.zeros(nan[0].shape[:-1], bool)
    mask[:2] = True
    found, valid = triangulate_jit(*nan, mask=mask)
    assert np.all(valid)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    # Weight zero masks too, and so does a pixel that is not finite.
    padded = [np.nan_to_num(a) for a in nan]
    weighted, _ = triangulate_jit(*padded, mask.astype(float))
    np.testing.assert_allclose(weighted, expected, atol=1e-12)
    unseen, _ = triangulate_jit(nan[0], *padded[1:])
    np.testing.assert_allclose(unseen, expected, atol=1e-12)


def test_weights_pull_towards_their_views(look_at, cloud, rng, x64):
    cams, points, uv = _seen(look_at, cloud, num_views=4)
    uv[3] += 20
    weights = np.ones(uv.shape[:-1])
    plain, _ = triangulate_jit(uv, cams.K, cams.T_cam_from_world, weights)
    # A new array: JAX may still be reading the first one, in place.
    doubting = np.array([1, 1, 1, 1e-3])[:, None] * weights
    trusting, _ = triangulate_jit(uv, cams.K, cams.T_cam_from_world, doubting)
    error = [np.linalg.norm(found - points, axis=-1).max() for found in (plain, trusting)]
    assert error[1] < 1e-2 * error[0]
    half, _ = triangulate_jit(uv, cams.K, cams.T_cam_from_world, 0.5 * doubting)
    np.testing.assert_allclose(half, trusting, atol=1e-12)


def test_permuting_views_and_points(look_at, cloud, rng, x64):
    cams, _, uv = _seen(look_at, cloud, num_views=3)
    uv = uv + rng.normal(size=uv.shape)
    expected, _ = triangulate_jit(uv, cams.K, cams.T_cam_from_world)
    views, points = np.asarray([2, 0, 1]), np.asarray([3, 1, 0, 4, 2])
    found, _ = triangulate_jit(uv[views][:, points], cams.K[views], cams.T_cam_from_world[views])
    np.testing.assert_allclose(found, np.asarray(expected)[points], atol=1e-12)


def _degenerate_cases(look_at, cloud):
    """Yield name, uv, K, T, mask of systems that do not determine the point."""
    cams, points, uv = _seen(look_at, cloud, num_views=3)
    K, T = cams.K, cams.T_cam_from_world
    none, one = np.zeros(uv.shape[:-1], bool), np.zeros(uv.shape[:-1], bool)
    one[1] = True
    every = ~none
    same = np.asarray([1, 1, 1])
    turned = rigid(rotation_from_axis_angle(np.asarray([0.0, 0.1, 0.0])), np.zeros(3)) @ T[1]
    turned_T = np.stack([T[1], turned, T[1]])
    turned_uv, _ = project(K[same], turned_T, points[None])
    yield "none", uv, K, T, none
    yield "one", uv, K, T, one
    yield "single", uv[:1], K[:1], T[:1], every[:1]
    yield "identical", uv[same], K[same], T[same], every
    yield "same centre", turned_uv + 0.5, K[same], turned_T, every
    parallel = np.stack([T[0], rigid(np.eye(3), np.asarray([0.1, 0.0, 0.0])) @ T[0]])
    yield "at infinity", uv[[0, 0]], K[[0, 0]], parallel, every[:2]
    face_to_face = np.stack([np.eye(4), rigid(np.diag([-1.0, 1.0, -1.0]), np.asarray([0.0, 0.0, 1.0]))])
    middle = np.broadcast_to(K[:2, None, :2, 2], uv[:2].shape)
    yield "on the baseline", middle, K[:2], face_to_face, every[:2]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("index", range(7))
def test_undetermined_points_are_flagged_and_finite(look_at, cloud, x64, index, dtype):
    name, uv, K, T, mask = list(_degenerate_cases(look_at, cloud))[index]
    args = [a.astype(dtype) for a in (uv, K, T)]

    def loss(uv, K, T):
        found, valid = triangulate(uv, K, T, mask=mask)
        return jnp.sum(found**2), (found, valid)

    gradients, (found, valid) = jax.jit(jax.grad(loss, argnums=(0, 1, 2), has_aux=True))(*args)
    assert not np.any(valid), name
    np.testing.assert_array_equal(found, 0)
    for gradient in gradients:
        np.testing.assert_array_equal(gradient, 0)


@pytest.mark.parametrize("normalise_rows", [True, False])
@pytest.mark.parametrize("noise_px", [0.0, 2.0])
def test_gradients_equal_finite_differences(look_at, cloud, rng, check_gradients, normalise_rows, noise_px):
    cams, _, uv = _seen(look_at, cloud, num_views=2, num_points=3)
    uv = uv + noise_px * rng.normal(size=uv.shape)
    weights = rng.uniform(0.5, 1.5, uv.shape[:-1])

    def found(uv, K, T, weights):
        return triangulate(uv, K, T, weights, normalise_rows=normalise_rows)[0]

    check_gradients(found, uv, cams.K, cams.T_cam_from_world, weights, eps=1e-7)


def test_null_vector_has_the_derivative_of_repeated_singular_values(check_gradients, rng):
    # Three equal singular values above the smallest: JAX's own derivative of the SVD is NaN here.
    Q = np.linalg.qr(rng.normal(size=(6, 4)))[0] * [2, 2, 2, 0.1]

    def projector(A):
        x, _ = null_vector(A)
        return x[:, None] * x

    check_gradients(projector, Q, eps=1e-7)
    check_gradients(lambda A: null_vector(A)[1][3], Q, eps=1e-7)


def test_float32_gradients_at_small_baselines(look_at, cloud, x64):
    cams, points, _ = _seen(look_at, cloud, num_views=1, num_points=3)
    shift = rigid(np.eye(3), np.asarray([1e-4, 0.0, 0.0]))
    T = np.stack([cams.T_cam_from_world[0], shift @ cams.T_cam_from_world[0]])
    # In the primary camera's frame, as the models work.
    points = transform_points(T[0], points)
    T = T @ invert_rigid(T[0])
    K = cams.K[[0, 0]]
    uv, _ = project(K, T, points[None])
    gradient = jax.jit(jax.grad(lambda uv, K, T: jnp.sum(triangulate(uv, K, T)[0] ** 2)))
    exact = gradient(uv, K, T)
    rough = gradient(*(a.astype(np.float32) for a in (uv, K, T)))
    assert np.all(triangulate_jit(*(a.astype(np.float32) for a in (uv, K, T)))[1])
    # float32 pixels alone move the point by 1e-5 px / (1e-4 m * 200 px) of its depth.
    assert np.abs(rough - exact).max() <= 2e-2 * np.abs(exact).max()


@pytest.mark.parity
@pytest.mark.parametrize("case", "ABD")
def test_reference_joints_of_the_release(shared_dir, case):
    inputs = np.load(shared_dir / "reference/poem_v2" / f"inputs_{case}.npz")
    golden = np.load(shared_dir / "reference/poem_v2" / f"golden_small_{case}.npz")
    ends = np.cumsum(inputs["views"])
    for b, views in enumerate(np.split(np.arange(ends[-1]), ends[:-1])):
        K, T = inputs["target_cam_intr"][views], invert_rigid(inputs["target_cam_extr"][views])
        check_cameras(Cameras(K, T), (256, 256))
        found, valid = triangulate_jit(golden["pred_joints_uv"][views], K, T, normalise_rows=False)
        if len(views) > 1:
            assert np.all(valid)
            np.testing.assert_allclose(found, golden["pred_ref_joints_3d"][b], atol=2e-5)
        else:
            assert not np.any(valid)
