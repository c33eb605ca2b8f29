import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models.vector_attention import (
    BracketedVectorAttention,
    Neighbours,
    VectorAttention,
    nearest_neighbours,
)

RNG = np.random.default_rng(0)
BATCH, QUERIES, POINTS, K, WIDTH = 2, 6, 9, 3, 8
EMBEDDINGS = RNG.normal(size=(BATCH, QUERIES, WIDTH)).astype(np.float32)
POSITIONS = RNG.normal(size=(BATCH, QUERIES, 3)).astype(np.float32)
FEATURES = RNG.normal(size=(BATCH, POINTS, WIDTH)).astype(np.float32)
BASIS = RNG.normal(size=(POINTS, 3)).astype(np.float32)
NEIGHBOURS = np.stack([RNG.permutation(POINTS)[:K] for _ in range(BATCH * QUERIES)])
NEIGHBOURS = NEIGHBOURS.reshape(BATCH, QUERIES, K).astype(np.int32)


def _of(index, points=BASIS) -> Neighbours:
    """The neighbours (batch, query, k) of points that all samples share."""
    index = np.moveaxis(index, -1, 0)
    return Neighbours(jnp.asarray(index), jnp.asarray(points)[index])


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
    found = module(EMBEDDINGS, POSITIONS, FEATURES, _of(NEIGHBOURS))
    np.testing.assert_allclose(found, _naive(module, EMBEDDINGS, POSITIONS, FEATURES), atol=1e-4)


def test_order_of_neighbours_does_not_matter(module):
    found = module(EMBEDDINGS, POSITIONS, FEATURES, _of(NEIGHBOURS))
    turned = module(EMBEDDINGS, POSITIONS, FEATURES, _of(NEIGHBOURS[..., ::-1]))
    np.testing.assert_allclose(found, turned, atol=1e-5)


def test_extreme_logits_stay_finite(module):
    module.gamma_out.kernel[...] *= 1e4
    run = jax.value_and_grad(lambda e: jnp.sum(module(e, POSITIONS, FEATURES, _of(NEIGHBOURS)) ** 2))
    value, gradient = run(jnp.asarray(EMBEDDINGS))
    assert np.isfinite(value)
    assert np.isfinite(gradient).all()


def test_gradients_match_finite_differences():
    with jax.enable_x64(True):
        module = VectorAttention(WIDTH, rngs=nnx.Rngs(0))
        graph, state = nnx.split(module)
        state = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), state)

        def total(embeddings, positions, features):
            read = nnx.merge(graph, state)(embeddings, positions, features, _of(NEIGHBOURS))
            return jnp.sum(jnp.sin(read))

        inputs = [jnp.asarray(x, jnp.float64) for x in (EMBEDDINGS, POSITIONS, FEATURES)]
        gradients = jax.grad(total, argnums=(0, 1, 2))(*inputs)
        for n, (x, gradient) in enumerate(zip(inputs, gradients, strict=True)):
            step = 1e-6 * RNG.normal(size=x.shape)
            plus, minus = ([*inputs[:n], x + sign * step, *inputs[n + 1 :]] for sign in (1, -1))
            difference = (total(*plus) - total(*minus)) / 2
            np.testing.assert_allclose(difference, jnp.sum(gradient * step), rtol=5e-4)


def test_masked_points_are_found_only_where_too_few_are_left():
    points = jnp.asarray(np.random.default_rng(3).normal(size=(1, 40, 3)), jnp.float32)
    queries = points[:, :6]
    for held, distinct in ((12, 8), (8, 8), (5, 5)):
        mask = jnp.arange(40) < held
        copies = jnp.where(mask[:, None], points, points[:, :1])
        index = np.asarray(nearest_neighbours(queries, copies, 8, mask[None]).index)[:, 0]
        assert index.shape == (8, 6)
        for of_query in index.T:
            assert sorted(of_query[of_query < held]) == sorted(set(of_query[of_query < held]))
            assert (of_query < held).sum() == distinct
        nearest = np.argsort(np.linalg.norm(copies[0, :held] - queries[0, :, None], axis=-1), -1)
        np.testing.assert_array_equal(index.T[:, :distinct], nearest[:, :distinct])


def test_nearest_neighbours_stand_where_their_points_are():
    points = RNG.normal(size=(BATCH, POINTS, 3)).astype(np.float32)
    found = nearest_neighbours(POSITIONS, points, K)
    distance = np.linalg.norm(POSITIONS[:, :, None] - points[:, None], axis=-1)
    expected = np.argsort(distance, -1)[..., :K]
    np.testing.assert_array_equal(np.moveaxis(found.index, 0, -1), expected)
    for b in range(BATCH):
        np.testing.assert_array_equal(np.moveaxis(found.positions, 0, 2)[b], points[b][expected[b]])


def test_anchors_are_neighbours_of_every_query(module):
    index, places = np.array([4, 0, 7]), RNG.normal(size=(3, 3)).astype(np.float32)
    everywhere = Neighbours(
        jnp.broadcast_to(index[:, None, None], (3, BATCH, QUERIES)),
        jnp.broadcast_to(places[:, None, None], (3, BATCH, QUERIES, 3)),
    )
    near = Neighbours(*(jnp.asarray(leaf)[:, None, None] for leaf in (index, places)))
    near = near._replace(index=jnp.broadcast_to(near.index, (3, BATCH, 1)))
    expected = module(EMBEDDINGS, POSITIONS, FEATURES, everywhere)
    np.testing.assert_allclose(module(EMBEDDINGS, POSITIONS, FEATURES, near), expected, atol=1e-6)
    known = module.with_deltas(POSITIONS, near)
    assert known.deltas is not None
    np.testing.assert_allclose(module(EMBEDDINGS, POSITIONS, FEATURES, known), expected, atol=1e-6)


@pytest.mark.parametrize(("k", "batch"), [(16, 1), (9, 2), (12, 4)])
def test_known_deltas_are_read_in_groups_with_the_same_result_and_gradients(k, batch):
    rng = np.random.default_rng(k)
    with jax.enable_x64(True):
        module = VectorAttention(WIDTH, rngs=nnx.Rngs(0))
        nnx.update(module, jax.tree.map(lambda leaf: leaf.astype(np.float64), nnx.state(module)))
        queries, points = rng.normal(size=(1, QUERIES, 3)), rng.normal(size=(1, 20, 3))
        one_by_one = nearest_neighbours(jnp.asarray(queries), jnp.asarray(points), k)
        tiled = one_by_one._replace(index=jnp.tile(one_by_one.index, (1, batch, 1)))
        grouped = module.with_deltas(queries, one_by_one)._replace(index=tiled.index)
        embeddings, features = (
            rng.normal(size=(batch, count, WIDTH)) * 3 for count in (QUERIES, points.shape[1])
        )

        def read(embeddings, features, neighbours):
            moved = module(embeddings, jnp.tile(queries, (batch, 1, 1)), features, neighbours)
            return jnp.sum(moved * jnp.arange(WIDTH)), moved

        run = jax.value_and_grad(read, (0, 1), has_aux=True)
        got, expected = (run(embeddings, features, n) for n in (grouped, tiled))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), got, expected)


def test_hundreds_of_known_neighbours_stay_a_loop():
    """Written out, a program of so many visits would not finish compiling."""
    module = VectorAttention(WIDTH, rngs=nnx.Rngs(0))

    points, features = np.random.default_rng(0).normal(size=(2, 200, 3)), np.ones((2, 200, WIDTH))

    def program(k: int) -> str:
        near = nearest_neighbours(POSITIONS, jnp.asarray(points, jnp.float32), k)
        known = module.with_deltas(POSITIONS, near)
        return (
            jax.jit(module).lower(EMBEDDINGS, POSITIONS, jnp.asarray(features, jnp.float32), known).as_text()
        )

    assert len(program(199)) < 1.2 * len(program(101))


def test_bracketed_attention_maps_before_and_after():
    module = BracketedVectorAttention(WIDTH, rngs=nnx.Rngs(1))
    near = _of(NEIGHBOURS)
    inner = module.attention(EMBEDDINGS, POSITIONS, module.before(FEATURES), near)
    expected = EMBEDDINGS + module.after(inner)
    np.testing.assert_allclose(module.to_basis(EMBEDDINGS, POSITIONS, FEATURES, near), expected, atol=1e-6)
    among = nearest_neighbours(POSITIONS, POSITIONS, K)
    mapped = module.before(EMBEDDINGS)
    expected = EMBEDDINGS + module.after(module.attention(mapped, POSITIONS, mapped, among))
    np.testing.assert_allclose(module.among_queries(EMBEDDINGS, POSITIONS, among), expected, atol=1e-6)


def test_the_release_scales_its_logits():
    """Dividing the logits by the root of the width equals scaling gamma's last layer; its bias is idle."""
    scaled = VectorAttention(WIDTH, like_release=True, rngs=nnx.Rngs(2))
    plain = VectorAttention(WIDTH, rngs=nnx.Rngs(3))
    for name in ("alpha", "beta", "psi", "gamma_in", "gamma_out", "xi_in", "xi_out"):
        getattr(plain, name).kernel[...] = getattr(scaled, name).kernel[...]
    plain.gamma_out.kernel[...] /= np.sqrt(WIDTH)
    scaled.gamma_out.bias[...] += 3.0
    arguments = (EMBEDDINGS, POSITIONS, FEATURES, _of(NEIGHBOURS))
    np.testing.assert_allclose(scaled(*arguments), plain(*arguments), atol=1e-5)
