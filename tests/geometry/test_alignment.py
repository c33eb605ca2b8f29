import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import orthogonal_procrustes

from poem_jax.geometry.alignment import apply_similarity, nearest_rotation, procrustes
from poem_jax.geometry.transforms import rotate_points, rotation_from_axis_angle


def _pair(rng, batch=(), noise=0.1):
    source = rng.normal(size=(*batch, 7, 3))
    R = rotation_from_axis_angle(rng.normal(size=(*batch, 3)))
    target = 1.7 * rotate_points(R, source) + rng.normal(size=(*batch, 1, 3))
    return source, target + noise * rng.normal(size=target.shape), R


def _error(source, target, **settings):
    return np.linalg.norm(apply_similarity(procrustes(source, target, **settings), source) - target, axis=-1)


def test_finds_the_similarity(rng, batch):
    source, target, R = _pair(rng, batch, noise=0)
    found = procrustes(source, target)
    np.testing.assert_allclose(found.R, R, atol=1e-12)
    np.testing.assert_allclose(found.scale, 1.7)
    np.testing.assert_allclose(apply_similarity(found, source), target, atol=1e-12)


def test_reflection_equals_scipy(rng):
    source, target, _ = _pair(rng)
    target[:, 0] *= -1
    X, Y = source - source.mean(0), target - target.mean(0)
    R, trace = orthogonal_procrustes(Y, X)
    expected = X @ R.T * trace / np.sum(X**2) + target.mean(0)
    found = procrustes(source, target, allow_reflection=True)
    np.testing.assert_allclose(apply_similarity(found, source), expected, atol=1e-12)
    assert np.linalg.det(found.R) < 0
    assert np.linalg.det(procrustes(source, target).R) > 0
    assert _error(source, target, allow_reflection=True).mean() < _error(source, target).mean()


@pytest.mark.parametrize("allow_reflection", [False, True])
def test_no_other_similarity_is_better(rng, allow_reflection):
    source, target, _ = _pair(rng, noise=0.3)
    best = procrustes(source, target, allow_reflection=allow_reflection)
    least = np.sum((apply_similarity(best, source) - target) ** 2)
    for _ in range(50):
        turn = rotation_from_axis_angle(0.05 * rng.normal(size=3))
        other = best._replace(R=turn @ best.R, scale=best.scale * rng.uniform(0.95, 1.05))
        moved = apply_similarity(other, source)
        moved = moved + (target - moved).mean(0)
        assert np.sum((moved - target) ** 2) >= least


def test_error_is_unchanged_by_similarity(rng, batch):
    source, target, _ = _pair(rng, batch)
    moved = 0.3 * rotate_points(rotation_from_axis_angle(rng.normal(size=(*batch, 3))), source) + 5
    np.testing.assert_allclose(_error(moved, target), _error(source, target), atol=1e-10)


def test_rigid_and_masked(rng):
    source, target, _ = _pair(rng)
    assert procrustes(source, target, with_scale=False).scale == 1
    mask = np.ones(7, bool)
    mask[-2:] = False
    expected = procrustes(source[:5], target[:5])
    source[5], target[6] = np.nan, np.inf
    for found, wanted in zip(procrustes(source, target, mask=mask), expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_norm_epsilon_is_added_to_the_norm(rng):
    source, target, _ = _pair(rng)
    norm = np.linalg.norm(source - source.mean(0))
    ratio = procrustes(source, target, norm_epsilon=0.1).scale / procrustes(source, target).scale
    np.testing.assert_allclose(ratio, (norm / (norm + 0.1)) ** 2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_numpy_jax_and_vmap_agree(rng, dtype, x64):
    source, target, _ = (a.astype(dtype) for a in _pair(rng, (3,)))
    expected = procrustes(source, target)
    results = [jax.jit(procrustes)(source, target), jax.jit(jax.vmap(procrustes))(source, target)]
    if dtype == np.float64:
        results.append(procrustes(jnp.asarray(source), jnp.asarray(target)))
    for result in results:
        for found, wanted in zip(result, expected, strict=True):
            assert found.dtype == wanted.dtype == dtype
            np.testing.assert_allclose(found, wanted, atol=1e-12 if dtype == np.float64 else 1e-5)


@pytest.mark.parametrize("allow_reflection", [False, True])
def test_gradients_equal_finite_differences(rng, check_gradients, allow_reflection):
    source, target, _ = _pair(rng)
    target[:, 0] *= -1

    def aligned(source, target):
        return apply_similarity(procrustes(source, target, allow_reflection=allow_reflection), source)

    check_gradients(aligned, source, target)


def test_gradient_is_right_where_singular_values_repeat(check_gradients):
    check_gradients(nearest_rotation, 2 * np.eye(3))
    check_gradients(nearest_rotation, np.diag([2.0, 2.0, 1.0]))
    # A plane determines its rotation.
    check_gradients(nearest_rotation, np.diag([2.0, 1.0, 0.0]))


@pytest.mark.parametrize("source", [np.zeros((4, 3)), np.ones((4, 3)), np.eye(4, 3) * [1, 0, 0]])
def test_degenerate_sources_are_finite(source, x64):
    target = np.arange(12.0).reshape(4, 3)

    def aligned(source, target):
        return apply_similarity(procrustes(source, target), source)

    value = jax.jit(aligned)(source, target)
    assert np.isfinite(value).all()
    if not np.ptp(source):
        np.testing.assert_allclose(value, np.broadcast_to(target.mean(0), (4, 3)))
    for jacobian in jax.jit(jax.jacobian(aligned, argnums=(0, 1)))(source, target):
        assert np.isfinite(jacobian).all()
