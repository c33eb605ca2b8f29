import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.models.layers import BATCH_NORM_EPSILON, MaskedBatchNorm, NormMode, masked_moments


@pytest.fixture
def images():
    return np.random.default_rng(0).normal(2.0, 3.0, (5, 4, 6, 3)).astype(np.float32)


MASK = np.array([True, False, True, True, False])


def test_moments_see_valid_images_only(images):
    images[~MASK] = 1e6
    mean, variance, count = masked_moments(jnp.asarray(images), jnp.asarray(MASK))
    kept = images[MASK].reshape(-1, 3)
    np.testing.assert_allclose(mean, kept.mean(0), rtol=1e-5)
    np.testing.assert_allclose(variance, kept.var(0), rtol=1e-4)
    assert count == len(kept)


def test_no_valid_image_is_harmless(images):
    norm = MaskedBatchNorm(3)
    y = norm(jnp.asarray(images), NormMode(jnp.zeros(5, bool)))
    assert np.isfinite(y).all()
    np.testing.assert_array_equal(norm.mean[...], 0)
    np.testing.assert_array_equal(norm.variance[...], 1)


def test_training_normalises_and_moves_the_running_statistics_as_torch_does(images):
    norm = MaskedBatchNorm(3)
    y = np.asarray(norm(jnp.asarray(images), NormMode(jnp.asarray(MASK))))
    kept = images[MASK].reshape(-1, 3)
    expected = (kept - kept.mean(0)) / np.sqrt(kept.var(0) + BATCH_NORM_EPSILON)
    np.testing.assert_allclose(y[MASK].reshape(-1, 3), expected, atol=1e-4)
    np.testing.assert_allclose(norm.mean[...], 0.1 * kept.mean(0), rtol=1e-5)
    np.testing.assert_allclose(norm.variance[...], 0.9 + 0.1 * kept.var(0, ddof=1), rtol=1e-4)


def test_inference_uses_running_statistics(images):
    norm = MaskedBatchNorm(3)
    norm.mean[...], norm.variance[...] = jnp.full(3, 2.0), jnp.full(3, 9.0)
    y = norm(jnp.asarray(images), NormMode())
    np.testing.assert_allclose(y, (images - 2) / np.sqrt(9 + BATCH_NORM_EPSILON), rtol=1e-5, atol=1e-6)


def test_moments_over_devices_equal_those_of_the_whole(images):
    whole = masked_moments(jnp.asarray(images[:4]), jnp.asarray(MASK[:4]))
    halves = (images[:4].reshape(2, 2, 4, 6, 3), MASK[:4].reshape(2, 2))
    parts = jax.vmap(lambda x, m: masked_moments(x, m, "device"), axis_name="device")(*halves)
    for part, expected in zip(parts, whole, strict=True):
        np.testing.assert_allclose(part[0], expected, rtol=1e-5)
        np.testing.assert_allclose(part[1], expected, rtol=1e-5)


def test_a_small_variance_beside_a_large_mean_keeps_its_digits():
    images = np.random.default_rng(0).normal(1000.0, 0.1, (5, 4, 6, 3)).astype(np.float32)
    _, variance, _ = masked_moments(jnp.asarray(images), jnp.asarray(MASK))
    exact = images[MASK].reshape(-1, 3).astype(np.float64).var(0)
    np.testing.assert_allclose(variance, exact, rtol=1e-3)
