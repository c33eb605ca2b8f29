import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.models.decoder import MultiHeadAttention
from poem_jax.models.layers import layer_norm

RNG = np.random.default_rng(0)
QUERIES, TOKENS = (RNG.normal(size=(2, n, 8)).astype(np.float32) for n in (5, 7))


def test_equation_10_head_by_head():
    module = MultiHeadAttention(8, 2, rngs=nnx.Rngs(0))
    q, k, v = module.query(QUERIES), module.key(TOKENS), module.value(TOKENS)
    read = np.zeros((2, 5, 8))
    for sample in range(2):
        for head in (slice(0, 4), slice(4, 8)):
            for i in range(5):
                logits = np.asarray(k[sample, :, head] @ q[sample, i, head]) / 2
                weights = np.exp(logits) / np.exp(logits).sum()
                read[sample, i, head] = weights @ np.asarray(v[sample, :, head])
    expected = read @ np.asarray(module.out.kernel[...])
    np.testing.assert_allclose(module(QUERIES, TOKENS), expected, atol=1e-5)


def test_layer_norm():
    x = jnp.asarray(3 * QUERIES + 2)
    y = layer_norm(8, 1e-5, rngs=nnx.Rngs(0))(x)
    np.testing.assert_allclose(jnp.mean(y, -1), 0, atol=1e-6)
    np.testing.assert_allclose(jnp.std(y, -1), 1, atol=1e-4)


def test_gradients_are_finite_for_equal_tokens():
    module = MultiHeadAttention(8, 2, rngs=nnx.Rngs(0))
    gradient = jax.grad(lambda x: jnp.sum(module(x, jnp.zeros((2, 7, 8))) ** 2))(jnp.asarray(QUERIES))
    assert np.isfinite(gradient).all()
