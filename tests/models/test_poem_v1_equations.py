"""The paper's POEM v1, part by part, against equations written in NumPy; and how far gradients reach.

The oracles use a module's weights and none of its code.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.model import template_queries
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES, ROOT_JOINT, QueryOrder
from poem_jax.models.poem_v1 import (
    GlobalAndVertexEmbedding,
    GlobalEmbedding,
    PaperDecoder,
    PaperTokens,
    VertexEmbedding,
)
from poem_jax.models.poem_v1_config import PointDecoderConfig
from poem_jax.models.poem_v1_release import ReleaseDecoder
from poem_jax.models.poem_v1_start import LearnedStart, Scene, Start, TriangulatedStart, ViewFeatures
from poem_jax.models.presets import preset
from poem_jax.models.world_frame import enter_working_frame
from tests.models import numpy_geometry
from tests.small_presets import small

V1 = small(preset("v1"))
WIDTH, HEADS, LAYERS, K, QUERIES, POINTS = 8, 2, 2, 3, 5, 7
DECODER = PointDecoderConfig(num_layers=LAYERS, num_neighbours=K, num_heads=HEADS, ffn_expansion=2)


def _random(module: nnx.Module, scale: float = 0.3) -> nnx.Module:
    """Draw all weights, so that zero biases and offsets hide nothing."""
    rng = np.random.default_rng(1)
    weights = nnx.state(module, nnx.Param)
    nnx.update(module, jax.tree.map(lambda x: scale * rng.normal(size=x.shape).astype(x.dtype), weights))
    return module


def _linear(layer: nnx.Linear, x: np.ndarray) -> np.ndarray:
    bias = 0 if layer.bias is None else np.asarray(layer.bias[...], np.float64)
    return x @ np.asarray(layer.kernel[...], np.float64) + bias


def _relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


def _norm(layer: nnx.LayerNorm, x: np.ndarray) -> np.ndarray:
    y = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return y * np.asarray(layer.scale[...]) + np.asarray(layer.bias[...])


def _softmax(x: np.ndarray, axis: int) -> np.ndarray:
    weights = np.exp(x - x.max(axis, keepdims=True))
    return weights / weights.sum(axis, keepdims=True)


def _self_attention(m, e: np.ndarray) -> np.ndarray:
    q, k, v = (_linear(layer, e) for layer in (m.query, m.key, m.value))
    size = WIDTH // HEADS
    heads = [slice(size * i, size * (i + 1)) for i in range(HEADS)]
    read = [_softmax(q[:, h] @ k[:, h].T / np.sqrt(size), -1) @ v[:, h] for h in heads]
    return _linear(m.out, np.concatenate(read, -1))


def _vector_attention(m, e, x, features, points, held) -> np.ndarray:
    """Paper, eq. 11, over the K nearest of the points that the ball holds."""
    out = []
    for i in range(len(x)):
        distance = np.where(held, np.linalg.norm(points - x[i], axis=-1), np.inf)
        near = np.argsort(distance)[:K]
        delta = _linear(m.xi_out, _relu(_linear(m.xi_in, x[i] - points[near])))
        subtraction = _linear(m.alpha, e[i]) - _linear(m.beta, features[near])
        logits = _linear(m.gamma_out, _relu(_linear(m.gamma_in, subtraction + delta)))
        out.append((_softmax(logits, 0) * (_linear(m.psi, features[near]) + delta)).sum(0))
    return np.array(out)


def _move(points, offset):
    """Unlike a sum, so that it shows who moves the points."""
    return points + jnp.tanh(offset)


@pytest.fixture
def clouds():
    """Embeddings and places of two samples' queries, features and places of their basis points."""
    rng = np.random.default_rng(0)
    shapes = ((QUERIES, WIDTH), (QUERIES, 3), (POINTS, WIDTH), (POINTS, 3))
    return [rng.normal(size=(2, *shape)).astype(np.float32) for shape in shapes]


def test_the_paper_s_layers(clouds):
    module = _random(PaperDecoder(DECODER, WIDTH, rngs=nnx.Rngs(0)))
    held = np.array([[True] * 4 + [False] * 3, [True, False] * 3 + [True]])
    found = module(*map(jnp.asarray, clouds), jnp.asarray(held), _move)
    for b in range(2):
        e, x, features, points = (leaf[b].astype(np.float64) for leaf in clouds)
        for layer, moved in zip(module.layers, found, strict=True):
            first, second = layer.norms
            e = _norm(first, e + _self_attention(layer.self_attention, e))
            read = _vector_attention(layer.vector_attention, e, x, features, points, held[b])
            e = _norm(second, e + read)
            x = x + np.tanh(_linear(layer.feed_forward.offset, _relu(_linear(layer.feed_forward.hidden, e))))
            np.testing.assert_allclose(moved[b], x, atol=2e-5)


@pytest.mark.parametrize("kind", [PaperDecoder, ReleaseDecoder])
def test_gradients_pass_from_layer_to_layer_through_the_positions(kind, clouds):
    """The last layer's points against what the first layer adds, by finite differences: all points are
    neighbours here, so that none changes."""
    embeddings, queries, features, points = map(jnp.asarray, clouds)
    points, embeddings = points[:, :QUERIES], embeddings[:1]
    config = PointDecoderConfig(LAYERS, QUERIES, HEADS, ffn_expansion=1)
    graph, state = nnx.split(_random(kind(config, WIDTH, rngs=nnx.Rngs(0)), 0.4))
    rest = (jnp.ones((1, QUERIES), bool), lambda x, offset: x + offset) if kind is PaperDecoder else ()
    shares = [jax.nn.sigmoid(leaf[:1]) for leaf in (queries, points)]

    @jax.jit
    def total(offset):
        module = nnx.merge(graph, state)
        first = module.layers[0]
        (first.feed_forward if kind is PaperDecoder else first.branch).offset.bias = nnx.Param(offset)
        moved = module(embeddings, shares[0], features[:1, :QUERIES], shares[1], *rest)
        return jnp.sum(jnp.sin(3 * moved[-1]))

    offset, step = jnp.array([0.1, -0.2, 0.3]), 5e-3
    gradient = jax.grad(total)(offset)
    axes = step * jnp.eye(3)
    differences = [(total(offset + axis) - total(offset - axis)) / (2 * step) for axis in axes]
    assert np.abs(gradient).min() > 0.05
    np.testing.assert_allclose(gradient, differences, rtol=0.02, atol=5e-3)


def _seen(keypoints_px) -> ViewFeatures:
    views = keypoints_px.shape[:2]
    return ViewFeatures(
        keypoints_px,
        jnp.zeros((*views, NUM_JOINTS, 4, 4)),
        jnp.zeros((*views, 4, 4, 8)),
        jnp.zeros((*views, 16)),
    )


def test_two_stages_start_at_the_joints_and_gradients_pass_the_triangulation(make_scene):
    """Vertices are the same weighted sums of joints about joint 9 along x, y and z; joint 4, which one view
    alone sees, starts at joint 9."""
    views, cams = make_scene(1, 3)
    frame = enter_working_frame(views, cams, None, np.float32)
    module = _random(TriangulatedStart(V1, rngs=nnx.Rngs(0)))
    joints = np.random.default_rng(2).uniform(-0.08, 0.08, (NUM_JOINTS, 3)) + np.array([0, 0, 0.6])
    K, T = (np.asarray(leaf[0], np.float64) for leaf in frame.cams[:2])
    uv_px = np.array(
        [[numpy_geometry.pixels(k, t, joints)[0] for k, t in zip(K, T, strict=True)]], np.float32
    )
    uv_px[0, 1:, 4] = np.nan

    @jax.jit
    def start_of(uv_px):
        start = module(_seen(uv_px), frame)
        return jnp.sum(jnp.sin(20 * start.queries)), start

    gradient, start = jax.grad(start_of, has_aux=True)(jnp.asarray(uv_px))
    solved = np.arange(NUM_JOINTS) != 4
    np.testing.assert_array_equal(start.solved[0], solved)
    np.testing.assert_allclose(start.joints[0, solved], joints[solved], atol=2e-5)
    root = joints[ROOT_JOINT]
    about = np.where(solved[:, None], joints - root, 0)
    kernel, bias = (np.asarray(leaf[...], np.float64) for leaf in (module.mesh.kernel, module.mesh.bias))
    vertices = np.stack([about[:, i] @ kernel + bias for i in range(3)], -1)
    np.testing.assert_allclose(start.queries[0], np.concatenate([vertices, about]) + root, atol=1e-4)
    np.testing.assert_allclose(start.centre[0], root, atol=2e-5)
    assert start.valid.all()
    assert (np.abs(gradient[0][:, solved]).max(-1) > 1e-6).all()


def test_one_stage_starts_at_learned_shares_of_the_cuboid(make_scene):
    views, cams = make_scene(2, 3)
    config = small(preset("v1-1stage"))
    module = LearnedStart(config, rngs=nnx.Rngs(0))
    shares = np.asarray(module.points[...])
    assert 0 <= shares.min() < 0.01
    assert 0.99 < shares.max() < 1
    start = module(_seen(jnp.zeros((2, 3, 21, 2))), enter_working_frame(views, cams, None, np.float32))
    low, high = np.array(config.space.low), np.array(config.space.high)
    np.testing.assert_allclose(start.queries, [low + shares * (high - low)] * 2, atol=1e-6)
    np.testing.assert_allclose(start.centre, [config.first_stage.origin] * 2, atol=1e-7)


def test_without_points_queries_move_from_the_start_by_offsets_about_the_root():
    """DETR's decoder reads learned embeddings as its codes; one network of three layers makes offsets, in
    radii of the ball, of what every layer gives."""
    config, rng = small(preset("v1-wo-pt")), np.random.default_rng(3)
    module = _random(PaperTokens(config, default_hand(), rngs=nnx.Rngs(0)))
    embeddings, asked = rng.normal(size=(1, 2, NUM_QUERIES, V1.width)).astype(np.float32), []

    def decoder(codes, *rest):
        asked.append(codes)
        return jnp.asarray(embeddings)

    module.decoder = decoder
    queries, root = (rng.normal(size=shape).astype(np.float32) for shape in ((1, NUM_QUERIES, 3), (1, 3)))
    start = Start(jnp.asarray(queries), *[jnp.asarray(root)] * 2, None, None, jnp.ones(1, bool))
    eye = jnp.broadcast_to(jnp.eye(4), (1, 2, 4, 4))
    cams = Cameras(eye[..., :3, :3], eye, jnp.ones((1, 2), bool))
    maps, pooled, grid = (
        jnp.zeros((1, 2, 4, 4, V1.width)),
        jnp.zeros((1, 2, 16)),
        jnp.zeros((1, 2, 4, 4, 4, 3)),
    )
    layers = module(Scene(maps, pooled, cams, grid, None, start, None))
    np.testing.assert_array_equal(asked[0][0], module.embedding.table[...])
    network = module.offsets
    for found, e in zip(layers, embeddings[0].astype(np.float64), strict=True):
        for layer in network.hidden:
            e = _relu(_linear(layer, e))
        np.testing.assert_allclose(found[0], queries[0] + 0.1 * _linear(network.out, e), atol=1e-4)


def test_query_embeddings():
    """V: a table. G: the mean over the valid views of a linear map, beside the template. G&V: that mean plus
    a table."""
    hand = default_hand()
    pooled = np.random.default_rng(4).normal(size=(2, 3, 16)).astype(np.float32)
    mask = np.array([[True, True, True], [False, True, True]])
    vertex, beside, plus = (
        _random(kind(V1, hand, rngs=nnx.Rngs(0)))
        for kind in (VertexEmbedding, GlobalEmbedding, GlobalAndVertexEmbedding)
    )
    v, g, gv = (
        np.asarray(module(jnp.asarray(pooled), jnp.asarray(mask))) for module in (vertex, beside, plus)
    )
    np.testing.assert_array_equal(v[0], vertex.table[...])
    template = template_queries(hand, QueryOrder.VERTICES_FIRST) / 0.1
    for b, valid in enumerate(([0, 1, 2], [1, 2])):
        mean = np.mean([_linear(beside.to_global, pooled[b, i]) for i in valid], 0)
        both = np.concatenate([np.tile(mean, (NUM_QUERIES, 1)), template], -1)
        np.testing.assert_allclose(g[b], _linear(beside.mix, both), atol=1e-4)
        mean = np.mean([_linear(plus.to_global, pooled[b, i]) for i in valid], 0)
        np.testing.assert_allclose(gv[b], mean + np.asarray(plus.table[...]), atol=1e-5)
