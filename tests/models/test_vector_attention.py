import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models.vector_attention import VectorAttention

RNG = np.random.default_rng(0)
BATCH, QUERIES, POINTS, K, WIDTH = 2, 6, 9, 3, 8
EMBEDDINGS = RNG.normal(size=(BATCH, QUERIES, WIDTH)).astype(np.float32)
POSITIONS = RNG.normal(size=(BATCH, QUERIES, 3)).astype(np.float32)
FEATURES = RNG.normal(size=(BATCH, POINTS, WIDTH)).astype(np.float32)
BASIS = RNG.normal(size=(POINTS, 3)).astype(np.float32)
NEIGHBOURS = np.stack([RNG.permutation(POINTS)[:K] for _ in range(BATCH * QUERIES)])
NEIGHBOURS = NEIGHBOURS.reshape(BATCH, QUERIES, K).astype(np.int32)


@pytest.fixture
def module():
    made = VectorAttention(WIDTH, rngs=nnx.Rngs(0))
    for bias in (made.gamma_in.bias, made.xi_in.bias, made.xi_out.bias):
        bias[...] = jnp.asarray(RNG.normal(size=WIDTH), jnp.float32)
    return made


def _naive(m, embeddings, positions, features):
    """Equation 11 as it is written."""

    def relu(x):
        return np.maximum(np.asarray(x), 0)

    out = np.zeros(embeddings.shape)
    for b in range(BATCH):
        for i in range(QUERIES):
            logits, values = [], []
            for j in NEIGHBOURS[b, i]:
                delta = m.xi_out(relu(m.xi_in(positions[b, i] - BASIS[j])))
                subtraction = m.alpha(embeddings[b, i]) - m.beta(features[b, j])
                logits.append(m.gamma_out(relu(m.gamma_in(subtraction + delta))))
                values.append(m.psi(features[b, j]) + delta)
            weights = np.exp(np.array(logits))
            out[b, i] = (weights * np.array(values)).sum(0) / weights.sum(0)
    return out


def test_equation_11(module):
    found = module(EMBEDDINGS, POSITIONS, FEATURES, BASIS, NEIGHBOURS)
    np.testing.assert_allclose(found, _naive(module, EMBEDDINGS, POSITIONS, FEATURES), atol=1e-4)


def test_order_of_neighbours_does_not_matter(module):
    found = module(EMBEDDINGS, POSITIONS, FEATURES, BASIS, NEIGHBOURS)
    turned = module(EMBEDDINGS, POSITIONS, FEATURES, BASIS, NEIGHBOURS[..., ::-1])
    np.testing.assert_allclose(found, turned, atol=1e-5)


def test_extreme_logits_stay_finite(module):
    module.gamma_out.kernel[...] *= 1e4
    run = jax.value_and_grad(lambda e: jnp.sum(module(e, POSITIONS, FEATURES, BASIS, NEIGHBOURS) ** 2))
    value, gradient = run(jnp.asarray(EMBEDDINGS))
    assert np.isfinite(value)
    assert np.isfinite(gradient).all()


def test_gradients_match_finite_differences():
    with jax.enable_x64(True):
        module = VectorAttention(WIDTH, rngs=nnx.Rngs(0))
        graph, state = nnx.split(module)
        state = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), state)

        def total(embeddings, positions, features):
            read = nnx.merge(graph, state)(embeddings, positions, features, BASIS, NEIGHBOURS)
            return jnp.sum(jnp.sin(read))

        inputs = [jnp.asarray(x, jnp.float64) for x in (EMBEDDINGS, POSITIONS, FEATURES)]
        gradients = jax.grad(total, argnums=(0, 1, 2))(*inputs)
        for n, (x, gradient) in enumerate(zip(inputs, gradients, strict=True)):
            step = 1e-6 * RNG.normal(size=x.shape)
            plus, minus = ([*inputs[:n], x + sign * step, *inputs[n + 1 :]] for sign in (1, -1))
            difference = (total(*plus) - total(*minus)) / 2
            np.testing.assert_allclose(difference, jnp.sum(gradient * step), rtol=5e-4)
