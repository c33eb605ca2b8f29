"""DETR's decoder: its equations in NumPy, its masks, its dropout."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models.detr import DetrDecoder
from poem_jax.models.detr_config import DetrConfig

CONFIG, WIDTH = DetrConfig(num_layers=2, num_heads=2, ffn_width=12), 8
RNG = np.random.default_rng(0)
QUERY_CODES = RNG.normal(size=(2, 5, WIDTH)).astype(np.float32)
TOKENS, TOKEN_CODES = (RNG.normal(size=(2, 7, WIDTH)).astype(np.float32) for _ in range(2))
ALL = np.ones((2, 7), bool)


def decoder(config: DetrConfig = CONFIG) -> DetrDecoder:
    """Return a decoder with random weights; biases and norms too, which start at zero and one."""
    module = DetrDecoder(config, WIDTH, rngs=nnx.Rngs(0))
    rng = np.random.default_rng(1)
    weights = nnx.state(module, nnx.Param)
    nnx.update(module, jax.tree.map(lambda x: x + 0.2 * rng.normal(size=x.shape).astype(x.dtype), weights))
    return module


def _linear(layer: nnx.Linear, x: np.ndarray) -> np.ndarray:
    assert layer.bias is not None
    return x @ np.asarray(layer.kernel[...], np.float64) + np.asarray(layer.bias[...], np.float64)


def _norm(layer: nnx.LayerNorm, x: np.ndarray) -> np.ndarray:
    assert layer.scale is not None
    assert layer.bias is not None
    y = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return y * np.asarray(layer.scale[...]) + np.asarray(layer.bias[...])


def _attention(layer, queries, keys, values, mask) -> np.ndarray:
    q, k, v = _linear(layer.query, queries), _linear(layer.key, keys), _linear(layer.value, values)
    read = []
    for head in (slice(0, 4), slice(4, 8)):
        logits = np.where(mask, q[:, head] @ k[:, head].T / 2, -np.inf)
        weights = np.exp(logits - logits.max(-1, keepdims=True))
        read.append(weights / weights.sum(-1, keepdims=True) @ v[:, head])
    return _linear(layer.out, np.concatenate(read, -1))


def test_the_equations_of_detr():
    module = decoder()
    mask = RNG.random((2, 7)) < 0.6
    ours = module(QUERY_CODES, TOKENS, TOKEN_CODES, mask)
    for b, (code, token, place) in enumerate(zip(QUERY_CODES, TOKENS, TOKEN_CODES, strict=True)):
        x = np.zeros((5, WIDTH))
        for i, layer in enumerate(module.layers):
            first, second, third = layer.norms
            everyone = np.ones(5, bool)
            x = _norm(first, x + _attention(layer.self_attention, x + code, x + code, x, everyone))
            x = _norm(second, x + _attention(layer.cross_attention, x + code, token + place, token, mask[b]))
            x = _norm(third, x + _linear(layer.out, np.maximum(_linear(layer.hidden, x), 0)))
            np.testing.assert_allclose(ours[b, i], _norm(module.norm, x), atol=1e-5)


def test_masked_tokens_change_nothing_and_valid_ones_do():
    module, mask = decoder(), np.array([[True] * 4 + [False] * 3] * 2)
    other = np.where(mask[..., None], TOKENS, 1e3)
    ours = module(QUERY_CODES, TOKENS, TOKEN_CODES, mask)
    np.testing.assert_array_equal(module(QUERY_CODES, other, TOKEN_CODES, mask), ours)
    short = module(QUERY_CODES, TOKENS[:, :4], TOKEN_CODES[:, :4], ALL[:, :4])
    np.testing.assert_allclose(short, ours, atol=1e-6)
    assert np.abs(module(QUERY_CODES, TOKENS, TOKEN_CODES, ALL) - ours).max() > 1e-3


def test_the_order_of_the_tokens_does_not_matter():
    module, order = decoder(), RNG.permutation(7)
    ours = module(QUERY_CODES, TOKENS, TOKEN_CODES, ALL)
    turned = module(QUERY_CODES, TOKENS[:, order], TOKEN_CODES[:, order], ALL)
    np.testing.assert_allclose(turned, ours, atol=1e-5)


def test_codes_may_be_in_the_tokens():
    module = decoder()
    with_zeros = module(QUERY_CODES, TOKENS, np.zeros_like(TOKENS), ALL)
    np.testing.assert_array_equal(module(QUERY_CODES, TOKENS, None, ALL), with_zeros)


@pytest.mark.parametrize("mask", [ALL, ~ALL], ids=["all", "none"])
def test_numbers_and_gradients_are_finite(mask: np.ndarray):
    graph, weights = nnx.split(decoder())

    def loss(weights, tokens):
        return jnp.sum(nnx.merge(graph, weights)(QUERY_CODES, tokens, TOKEN_CODES, mask) ** 2)

    value, gradients = jax.value_and_grad(loss, (0, 1))(weights, jnp.asarray(TOKENS))
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


def test_dropout_draws_by_its_key():
    module, key = decoder(), jax.random.key(0)
    calm = module(QUERY_CODES, TOKENS, TOKEN_CODES, ALL)
    first, again = (module(QUERY_CODES, TOKENS, TOKEN_CODES, ALL, key) for _ in range(2))
    other = module(QUERY_CODES, TOKENS, TOKEN_CODES, ALL, jax.random.key(1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    assert np.abs(first - calm).max() > 1e-3
    without = decoder(replace(CONFIG, dropout=0.0))
    np.testing.assert_array_equal(without(QUERY_CODES, TOKENS, TOKEN_CODES, ALL, key), calm)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [("num_layers", 0, "num_layers"), ("num_heads", 0, "num_heads"), ("dropout", 1.0, "dropout")],
)
def test_what_a_decoder_cannot_be(field: str, value: float, message: str):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **{field: value})
