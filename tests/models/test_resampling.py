import jax
import numpy as np

from poem_jax.models.layers import double_bilinear, repeat_pixels

X = np.random.default_rng(0).normal(size=(2, 3, 5, 4)).astype(np.float32)


def test_repeat_pixels():
    np.testing.assert_array_equal(repeat_pixels(X, 4), X.repeat(4, 1).repeat(4, 2))


def test_double_bilinear_is_a_resize():
    expected = jax.image.resize(X, (2, 6, 10, 4), "bilinear")
    np.testing.assert_allclose(double_bilinear(X), expected, atol=1e-5)
