from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.geometry import transforms


def _random_rigid(rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
    R = transforms.rotation_from_axis_angle(rng.normal(size=(*batch, 3)))
    return transforms.rigid(R, rng.normal(size=(*batch, 3)))


def _singular_axis_angles() -> np.ndarray:
    """Zero, tiny, at the switch between series and quotient, and half turns about several axes."""
    axes = np.asarray([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.0, -0.8], [0.36, 0.48, 0.8]])
    angles = np.asarray([0.0, 1e-12, 1e-6, 0.00999, 0.01, 0.01001, 1.0, np.pi - 1e-7, np.pi])
    return (angles[:, None, None] * axes).reshape(-1, 3)


def test_inverse_and_composition(rng, batch):
    T_a_from_b, T_b_from_c = _random_rigid(rng, batch), _random_rigid(rng, batch)
    points_c = rng.normal(size=(*batch, 7, 3))
    identity = T_a_from_b @ transforms.invert_rigid(T_a_from_b)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(4), identity.shape), atol=1e-12)
    composed = transforms.transform_points(T_a_from_b @ T_b_from_c, points_c)
    stepwise = transforms.transform_points(T_a_from_b, transforms.transform_points(T_b_from_c, points_c))
    np.testing.assert_allclose(composed, stepwise, atol=1e-12)


def test_transform_points_equals_a_loop(rng):
    T = _random_rigid(rng, (2,))
    points = rng.normal(size=(2, 3, 3))
    expected = [[(T[b] @ [*p, 1])[:3] for p in points[b]] for b in range(2)]
    np.testing.assert_allclose(transforms.transform_points(T, points), expected, atol=1e-12)


def test_rotation_from_axis_angle_equals_scipy(rng):
    v = np.concatenate([rng.normal(size=(50, 3)) * 2, _singular_axis_angles()])
    np.testing.assert_allclose(
        transforms.rotation_from_axis_angle(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-14
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_axis_angle_round_trip(rng, dtype):
    v = np.concatenate([rng.normal(size=(50, 3)), _singular_axis_angles()]).astype(dtype)
    R = transforms.rotation_from_axis_angle(v)
    back = transforms.axis_angle_from_rotation(R)
    atol = 1e-13 if dtype == np.float64 else 3e-6
    np.testing.assert_allclose(transforms.rotation_from_axis_angle(back), R, atol=atol)
    inside = np.linalg.norm(v, axis=-1) < 3
    np.testing.assert_allclose(back[inside], v[inside], atol=atol)
    assert np.linalg.norm(back, axis=-1).max() <= np.pi + 1e-6


def test_6d_round_trip_and_rows(rng, batch):
    R = _random_rigid(rng, batch)[..., :3, :3]
    x = transforms.sixd_from_rotation(R)
    np.testing.assert_allclose(x[..., :3], R[..., 0, :])
    np.testing.assert_allclose(transforms.rotation_from_6d(x), R, atol=1e-12)
    # Scale, and adding the first vector to the second, change nothing.
    sheared = np.concatenate([3 * x[..., :3], 0.5 * x[..., 3:] + 2 * x[..., :3]], axis=-1)
    np.testing.assert_allclose(transforms.rotation_from_6d(sheared), R, atol=1e-12)


@pytest.mark.parametrize("x", [np.zeros(6), [1, 2, 3, 2, 4, 6], [0, 0, 0, 1, 0, 0], [0, 1, 0, 0, 0, 0]])
def test_degenerate_6d_is_a_rotation_with_finite_gradients(x, x64):
    x = jnp.asarray(x, float)
    R = np.asarray(jax.jit(transforms.rotation_from_6d)(x))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(R), 1)
    assert np.isfinite(jax.jit(jax.jacobian(transforms.rotation_from_6d))(x)).all()


def test_rotation_about_z_turns_x_to_y():
    R = transforms.rotation_about_z(np.pi / 2)
    np.testing.assert_allclose(R @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(
        transforms.rotation_about_z(np.asarray(0.3)),
        transforms.rotation_from_axis_angle(np.asarray([0, 0, 0.3])),
        atol=1e-15,
    )


FUNCTIONS: dict[str, tuple[Callable, tuple[int, ...]]] = {
    "rotation_from_axis_angle": (transforms.rotation_from_axis_angle, (3,)),
    "rotation_from_6d": (transforms.rotation_from_6d, (6,)),
    "rotation_about_z": (transforms.rotation_about_z, ()),
    "skew_matrix": (transforms.skew_matrix, (3,)),
    "axis_angle_of_axis_angle": (
        lambda v: transforms.axis_angle_from_rotation(transforms.rotation_from_axis_angle(v)),
        (3,),
    ),
    "inverse_of_axis_angle": (
        lambda v: transforms.invert_rigid(transforms.rigid(transforms.rotation_from_axis_angle(v), v)),
        (3,),
    ),
}


def _all_functions(inputs: dict) -> dict:
    return {name: function(inputs[name]) for name, (function, _) in FUNCTIONS.items()}


def test_numpy_jax_and_vmap_agree(rng, batch):
    inputs = {
        name: rng.normal(size=(*batch, *shape)).astype(np.float32) for name, (_, shape) in FUNCTIONS.items()
    }
    expected = _all_functions(inputs)
    results = [jax.jit(_all_functions)(inputs)]
    if len(batch) == 1:
        results.append(jax.jit(jax.vmap(_all_functions))(inputs))
    for name, wanted in expected.items():
        assert isinstance(wanted, np.ndarray)
        assert wanted.dtype == np.float32
        assert wanted.shape[: len(batch)] == batch
        for result in results:
            np.testing.assert_allclose(result[name], wanted, atol=1e-5, err_msg=name)


def test_with_and_without_jit_agree(rng):
    function, shape = FUNCTIONS["axis_angle_of_axis_angle"]
    x = jnp.asarray(rng.normal(size=shape), jnp.float32)
    np.testing.assert_allclose(function(x), jax.jit(function)(x), atol=1e-5)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_gradients_equal_finite_differences(rng, check_gradients, name):
    function, shape = FUNCTIONS[name]
    check_gradients(function, rng.normal(size=(3, *shape)))


def test_gradients_equal_finite_differences_at_singular_points(check_gradients):
    v = _singular_axis_angles()
    check_gradients(transforms.rotation_from_axis_angle, v)
    v = v[np.linalg.norm(v, axis=-1) < 3]
    round_trip, _ = FUNCTIONS["axis_angle_of_axis_angle"]
    jacobian = jax.jit(jax.vmap(jax.jacrev(round_trip)))(v)
    np.testing.assert_allclose(jacobian, np.broadcast_to(np.eye(3), jacobian.shape), atol=1e-8)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gradients_are_finite_at_singular_points(x64, dtype):
    v = _singular_axis_angles().astype(dtype)
    R = transforms.rotation_from_axis_angle(v)
    for function, x in (
        (transforms.rotation_from_axis_angle, v),
        (transforms.axis_angle_from_rotation, R),
    ):
        for differentiate in (jax.jacfwd, jax.jacrev):
            jacobian = jax.jit(jax.vmap(differentiate(function)))(x)
            assert jacobian.dtype == dtype
            assert np.isfinite(jacobian).all()
