import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.models.layers import double_bilinear, max_pool, repeat_pixels

RNG = np.random.default_rng(0)
X = RNG.normal(size=(2, 3, 5, 4)).astype(np.float32)


def test_repeat_pixels():
    np.testing.assert_array_equal(repeat_pixels(X, 4), X.repeat(4, 1).repeat(4, 2))


def test_double_bilinear_is_a_resize():
    expected = jax.image.resize(X, (2, 6, 10, 4), "bilinear")
    np.testing.assert_allclose(double_bilinear(X), expected, atol=1e-5)


def test_max_pool():
    x = RNG.normal(size=(2, 4, 6, 3)).astype(np.float32)
    expected = x.reshape(2, 2, 2, 3, 2, 3).max((2, 4))
    np.testing.assert_array_equal(max_pool(x, 2), expected)


def test_the_gradient_of_max_pool_survives_numbers_that_are_computed_twice():
    """After a batch norm, of which a compiler that optimises little makes two copies, rounded differently."""
    x, kernel = (RNG.normal(size=shape).astype(np.float32) for shape in ((6, 8, 8, 16), (3, 3, 16, 8)))

    def loss(x, kernel):
        y = jax.lax.conv_general_dilated(
            x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        mean = y.mean((0, 1, 2))
        variance = ((y - mean) ** 2).mean((0, 1, 2))
        normed = jax.nn.relu((y - mean) * jax.lax.rsqrt(variance + 1e-5))
        return jnp.sum(jax.nn.sigmoid(max_pool(normed, 2)))

    gradients = jax.grad(loss, argnums=(0, 1))
    careful = jax.jit(gradients)(x, kernel)
    quick = jax.jit(gradients, compiler_options={"xla_backend_optimization_level": 0})(x, kernel)
    for one, other in zip(careful, quick, strict=True):
        assert np.isfinite(other).all()
        np.testing.assert_allclose(one, other, atol=1e-5)
