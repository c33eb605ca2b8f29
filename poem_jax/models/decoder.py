"""Point-embedded Transformer decoder: query points read the basis points and move.

Paper, section "Point-Embedded Transformer Decoder". The layer of the paper and that of the release are two
classes with one signature. Coordinates are in units of the basis radius, about the root.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.hand.topology import NUM_QUERIES
from poem_jax.models.config import DecoderConfig, DecoderOutput, Design, NeighbourSearch
from poem_jax.models.layers import dropout, layer_norm, linear, normal
from poem_jax.models.vector_attention import (
    BracketedVectorAttention,
    Neighbours,
    VectorAttention,
    nearest_neighbours,
)
from poem_jax.typing import Array, Bool, Float, PRNGKeyArray

PAPER_EPSILON, RELEASE_EPSILON = 1e-5, 1e-12
"""Of the layer norms."""


class Surroundings(NamedTuple):
    """The neighbours of every query point."""

    basis: Neighbours
    queries: Neighbours | None
    """None where queries do not read each other."""


def shared(surroundings: Surroundings, batch_size: int) -> Surroundings:
    """Give the surroundings of one sample to a whole batch."""

    def spread(near: Neighbours) -> Neighbours:
        k, _, query = near.index.shape
        return near._replace(index=jnp.broadcast_to(near.index, (k, batch_size, query)))

    basis, queries = surroundings
    return Surroundings(spread(basis), None if queries is None else spread(queries))


class Decoder(nnx.Module):
    """Learned query embeddings and a row of layers that each move the query points."""

    def __init__(self, config: DecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.embeddings = nnx.Param(normal(rngs.params(), (NUM_QUERIES, width)))
        layer = ReleaseLayer if config.layer is Design.RELEASE else PaperLayer
        self.layers = nnx.List(
            layer(config, width, is_last=i == config.num_layers - 1, rngs=rngs)
            for i in range(config.num_layers)
        )
        self.locate = CoordinateEmbedding(width, rngs=rngs) if config.embed_coordinates else None

    def __call__(
        self,
        queries: Float[Array, "batch query 3"],
        points: Float[Array, "basis 3"],
        features: Float[Array, "batch basis c"],
        first: Surroundings | None = None,
        dropout_key: PRNGKeyArray | None = None,
    ) -> tuple[list[Float[Array, "batch query 3"]], Float[Array, "batch query c"]]:
        """Return the query points after every layer that moves them, and the last embeddings.

        `first`: whom the first layer reads, the same in all samples (batch 1); None = the nearest, as in the
        other layers.
        """
        embeddings = jnp.broadcast_to(self.embeddings[...], (*queries.shape[:-1], features.shape[-1]))
        if self.locate is not None:
            features = features + self.locate(points)
        surroundings = self._surroundings(queries, points) if first is None else shared(first, len(queries))
        moved = []
        for i, layer in enumerate(self.layers):
            if moved and self.config.neighbour_search is NeighbourSearch.EVERY_LAYER:
                surroundings = self._surroundings(queries, points)
            if self.locate is not None:
                embeddings = embeddings + self.locate(queries)
            key = None if dropout_key is None else jax.random.fold_in(dropout_key, i)
            embeddings, queries = layer(embeddings, queries, features, surroundings, key)
            moved.append(queries)
        return moved[: len(moved) - (self.config.output is DecoderOutput.HAND_PARAMETERS)], embeddings

    def _surroundings(self, queries: Array, points: Array) -> Surroundings:
        k = self.config.num_neighbours
        shared = jnp.broadcast_to(points, (queries.shape[0], *points.shape))
        among = self.config.layer is Design.RELEASE
        return Surroundings(
            nearest_neighbours(queries, shared, k),
            nearest_neighbours(queries, queries, k) if among else None,
        )


class PaperLayer(nnx.Module):
    """Queries read each other, the basis points, and their nearest basis points; then they move."""

    def __init__(self, config: DecoderConfig, width: int, *, is_last: bool, rngs: nnx.Rngs) -> None:
        self.basis_stride = config.cross_attention_basis_stride
        self.self_attention, self.cross_attention = _scalar_attentions(config, width, rngs)
        self.vector_attention = VectorAttention(width, rngs=rngs)
        self.norms = nnx.List(layer_norm(width, PAPER_EPSILON, rngs=rngs) for _ in range(3))
        moves = _moves(config, is_last)
        self.feed_forward = OffsetNetwork(width, config.ffn_expansion * width, rngs=rngs) if moves else None

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        surroundings: Surroundings,
        dropout_key: PRNGKeyArray | None = None,
    ) -> tuple[Float[Array, "batch query c"], Float[Array, "batch query 3"]]:
        """Return the updated embeddings and points."""
        after_queries, after_basis, after_nearest = self.norms
        keys = [None] * 2 if dropout_key is None else list(jax.random.split(dropout_key, 2))
        e = after_queries(embeddings + self.self_attention(embeddings, embeddings, keys[0]))
        e = after_basis(e + self.cross_attention(e, features[:, :: self.basis_stride], keys[1]))
        e = after_nearest(e + self.vector_attention(e, queries, features, surroundings.basis))
        return e, queries if self.feed_forward is None else queries + self.feed_forward(e)


class ReleaseLayer(nnx.Module):
    """Queries read the basis points twice, near queries, and near basis points; they move, then comes the
    feed-forward network."""

    def __init__(self, config: DecoderConfig, width: int, *, is_last: bool, rngs: nnx.Rngs) -> None:
        self.basis_stride, self.dropout_rate = config.cross_attention_basis_stride, config.dropout
        self.embed = linear(width, width, rngs=rngs)
        self.self_attention, self.cross_attention = _scalar_attentions(config, width, rngs)
        self.vector_attention = QueriesThenBasis(width, rngs=rngs)
        self.norms = nnx.List(layer_norm(width, RELEASE_EPSILON, rngs=rngs) for _ in range(2))
        moves = _moves(config, is_last)
        self.branch = OffsetNetwork(width, width, rngs=rngs) if moves else None
        # After the last offsets nobody reads the embeddings.
        unread = is_last and moves
        self.feed_forward = None if unread else ResidualNetwork(config, width, rngs=rngs)

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        surroundings: Surroundings,
        dropout_key: PRNGKeyArray | None = None,
    ) -> tuple[Float[Array, "batch query c"], Float[Array, "batch query 3"]]:
        """Return the updated embeddings and points."""
        keys = [None] * 5 if dropout_key is None else list(jax.random.split(dropout_key, 5))
        after_first, after_second = self.norms
        e = dropout(self.embed(embeddings), self.dropout_rate, keys[0])
        tokens = dropout(self.embed(features), self.dropout_rate, keys[1])
        basis = tokens[:, :: self.basis_stride]
        e = after_first(e + self.self_attention(e, basis, keys[2]))
        e = after_second(e + self.cross_attention(e, basis, keys[3]))
        e = self.vector_attention(e, queries, tokens, surroundings)
        if self.branch is not None:
            queries = queries + self.branch(e)
        return e if self.feed_forward is None else self.feed_forward(e, keys[4]), queries

    def with_deltas(self, queries: Float[Array, "1 query 3"], surroundings: Surroundings) -> Surroundings:
        """Compute beforehand what this layer needs of queries and neighbours that never move."""
        vector, near = self.vector_attention, surroundings
        assert near.queries is not None
        return Surroundings(
            vector.basis.attention.with_deltas(queries, near.basis),
            vector.queries.attention.with_deltas(queries, near.queries),
        )


def _scalar_attentions(
    config: DecoderConfig, width: int, rngs: nnx.Rngs
) -> tuple["MultiHeadAttention", "MultiHeadAttention"]:
    first, second = (
        MultiHeadAttention(width, config.num_heads, dropout_rate=config.dropout, rngs=rngs) for _ in range(2)
    )
    return first, second


def _moves(config: DecoderConfig, is_last: bool) -> bool:
    """Whether a layer regresses offsets; the last regresses these or parameters, never both."""
    return not is_last or config.output is DecoderOutput.OFFSETS


class QueriesThenBasis(nnx.Module):
    """Vector attention among the queries, then to the basis points (release)."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.queries, self.basis = (BracketedVectorAttention(width, rngs=rngs) for _ in range(2))

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        surroundings: Surroundings,
    ) -> Float[Array, "batch query c"]:
        """Return the updated embeddings."""
        assert surroundings.queries is not None
        embeddings = self.queries.among_queries(embeddings, queries, surroundings.queries)
        return self.basis.to_basis(embeddings, queries, features, surroundings.basis)


class OffsetNetwork(nnx.Module):
    """Two layers from embedding to offset; zero at first, so that learning starts from the template."""

    def __init__(self, width: int, hidden: int, *, rngs: nnx.Rngs) -> None:
        self.hidden = linear(width, hidden, rngs=rngs)
        self.offset = nnx.Linear(hidden, 3, kernel_init=nnx.initializers.zeros, rngs=rngs)

    def __call__(self, embeddings: Float[Array, "batch query c"]) -> Float[Array, "batch query 3"]:
        """Regress offsets."""
        return self.offset(jax.nn.relu(self.hidden(embeddings)))


class ResidualNetwork(nnx.Module):
    """Feed-forward network of the embeddings: LayerNorm(e + W_2 gelu(W_1 e)), with the exact (erf) GELU."""

    def __init__(self, config: DecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.dropout_rate, hidden = config.dropout, config.ffn_expansion * width
        self.hidden, self.out = linear(width, hidden, rngs=rngs), linear(hidden, width, rngs=rngs)
        self.norm = layer_norm(width, RELEASE_EPSILON, rngs=rngs)

    def __call__(
        self, embeddings: Float[Array, "batch query c"], dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "batch query c"]:
        """Update."""
        update = self.out(jax.nn.gelu(self.hidden(embeddings), approximate=False))
        return self.norm(embeddings + dropout(update, self.dropout_rate, dropout_key))


class CoordinateEmbedding(nnx.Module):
    """Two layers from a coordinate to an embedding."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.hidden, self.out = linear(3, width, rngs=rngs), linear(width, width, rngs=rngs)

    def __call__(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch c"]:
        """Embed."""
        return self.out(jax.nn.relu(self.hidden(points)))


class MultiHeadAttention(nnx.Module):
    """softmax(Q K^T / sqrt(d / heads)) V, projected."""

    def __init__(self, width: int, num_heads: int, *, dropout_rate: float = 0.0, rngs: nnx.Rngs) -> None:
        self.num_heads, self.dropout_rate = num_heads, dropout_rate
        self.query, self.key, self.value, self.out = (linear(width, width, rngs=rngs) for _ in range(4))

    def __call__(
        self,
        queries: Float[Array, "batch query c"],
        tokens: Float[Array, "batch token c"],
        dropout_key: PRNGKeyArray | None = None,
        *,
        values: Float[Array, "batch token c"] | None = None,
        token_mask: Bool[Array, "batch token"] | None = None,
    ) -> Float[Array, "batch query c"]:
        """Let every query read all tokens; in training some of the weights and results are dropped.

        Args:
            queries: who reads.
            tokens: what the keys are made of, and the values too unless `values` are given.
            dropout_key: None drops nothing.
            values: what is read of the tokens.
            token_mask: True = a token that may be read, None = all. Of a sample without any, what is read
                means nothing, and is finite where the tokens are.
        """
        q, k, v = (
            self._heads(layer(x))
            for layer, x in (
                (self.query, queries),
                (self.key, tokens),
                (self.value, tokens if values is None else values),
            )
        )
        # One row a head, as in `_heads`.
        mask = None if token_mask is None else jnp.repeat(token_mask, self.num_heads, 0)
        if dropout_key is None:
            keys, out_key = None, None
        else:
            weights_key, out_key = jax.random.split(dropout_key)
            keys = jax.random.split(weights_key, len(q))
        attend = functools.partial(_attend, dropout_rate=self.dropout_rate)
        # One head of one sample at a time, recomputed in the backward pass: no array is larger than its map,
        # and each product is one plain matrix product, several times faster on a CPU than with heads inside.
        read = jax.lax.map(jax.checkpoint(attend), (q, k, v, keys, mask))  # pyright: ignore[reportPrivateImportUsage]
        return dropout(self.out(self._joined(read, len(queries))), self.dropout_rate, out_key)

    def _heads(self, x: Float[Array, "batch token c"]) -> Float[Array, "batch_head token c2"]:
        batch, token, c = x.shape
        split = x.reshape(batch, token, self.num_heads, c // self.num_heads)
        return jnp.swapaxes(split, 1, 2).reshape(batch * self.num_heads, token, c // self.num_heads)

    def _joined(self, read: Float[Array, "batch_head query c2"], batch: int) -> Float[Array, "batch query c"]:
        _, query, c = read.shape
        split = read.reshape(batch, self.num_heads, query, c)
        return jnp.swapaxes(split, 1, 2).reshape(batch, query, self.num_heads * c)


def _attend(
    arguments: tuple[Array, Array, Array, PRNGKeyArray | None, Array | None], *, dropout_rate: float
) -> Float[Array, "query c"]:
    """Let the queries of one head read its tokens."""
    q, k, v, key, mask = arguments
    logits = (q * q.shape[-1] ** -0.5) @ k.T
    if mask is not None:
        # Not minus infinity, of which a row without any valid token would make NaN.
        logits = jnp.where(mask, logits, jnp.finfo(logits.dtype).min)
    weights = jnp.exp(logits - jax.lax.stop_gradient(jnp.max(logits, -1, keepdims=True)))
    total = jnp.sum(weights, -1, keepdims=True)
    # Divided last: the map is passed over once less.
    return (dropout(weights, dropout_rate, key) @ v) / total
