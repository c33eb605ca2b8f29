"""Point-embedded Transformer decoder: query points read the basis points and move.

Paper, section "Point-Embedded Transformer Decoder"; the released decoder by named choices of `DecoderConfig`.

Coordinates are in units of the basis radius, about the root.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.hand.topology import NUM_QUERIES
from poem_jax.models.config import (
    AttentionKeys,
    CoordinateUpdate,
    DecoderConfig,
    DecoderOutput,
    NeighbourSearch,
    VectorForm,
)
from poem_jax.models.layers import dropout, layer_norm, linear, normal
from poem_jax.models.vector_attention import (
    BracketedVectorAttention,
    Neighbours,
    VectorAttention,
    anchored,
    nearest_neighbours,
)
from poem_jax.typing import Array, Float, Int, PRNGKeyArray


class Anchors(NamedTuple):
    """Rows that all queries read in the first layer, and the positions that count for them."""

    index: Int[Array, " k"]
    positions: Float[Array, "k 3"]


class Surroundings(NamedTuple):
    """The neighbours of every query point."""

    basis: Neighbours
    queries: Neighbours | None
    """None where queries do not read each other."""


def around_anchors(anchors: Anchors) -> Surroundings:
    """Let all queries of all samples read the same anchors, of queries and basis alike (batch 1)."""
    everywhere = anchored(anchors.index, anchors.positions)
    return Surroundings(everywhere, everywhere)


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
        # The last layer regresses offsets or parameters, never both.
        kinds = [DecoderOutput.OFFSETS] * (config.num_layers - 1) + [config.output]
        self.layers = nnx.List(
            DecoderLayer(config, width, output=kind, is_last=i == config.num_layers - 1, rngs=rngs)
            for i, kind in enumerate(kinds)
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

    def with_first_deltas(self, queries: Float[Array, "1 query 3"], first: Surroundings) -> Surroundings:
        """Compute beforehand what the first layer needs of queries and neighbours that never move."""
        vector = self.layers[0].vector_attention
        if isinstance(vector, VectorAttention):
            return first._replace(basis=vector.with_deltas(queries, first.basis))
        assert first.queries is not None
        return Surroundings(
            vector.basis.attention.with_deltas(queries, first.basis),
            vector.queries.attention.with_deltas(queries, first.queries),
        )

    def _surroundings(self, queries: Array, points: Array) -> Surroundings:
        k = self.config.num_neighbours
        shared = jnp.broadcast_to(points, (queries.shape[0], *points.shape))
        among = self.config.vector_form is VectorForm.QUERIES_THEN_BASIS
        return Surroundings(
            nearest_neighbours(queries, shared, k),
            nearest_neighbours(queries, queries, k) if among else None,
        )


class DecoderLayer(nnx.Module):
    """Two scalar attentions, vector attention, and what moves the points."""

    def __init__(
        self, config: DecoderConfig, width: int, *, output: DecoderOutput, is_last: bool, rngs: nnx.Rngs
    ) -> None:
        self.config = config
        self.embed = linear(width, width, rngs=rngs) if config.shared_embedding else None
        self.self_attention, self.cross_attention = (
            MultiHeadAttention(width, config.num_heads, dropout_rate=config.dropout, rngs=rngs)
            for _ in range(2)
        )
        basis_alone = config.vector_form is VectorForm.BASIS
        self.vector_attention = (VectorAttention if basis_alone else QueriesThenBasis)(width, rngs=rngs)
        self.norms = nnx.List(
            layer_norm(width, config.layer_norm_epsilon, rngs=rngs) for _ in range(3 if basis_alone else 2)
        )
        moves, hidden = output is DecoderOutput.OFFSETS, config.ffn_expansion * width
        if config.coordinate_update is CoordinateUpdate.FEED_FORWARD:
            self.branch = None
            self.feed_forward = OffsetNetwork(width, hidden, rngs=rngs) if moves else None
        else:
            self.branch = OffsetNetwork(width, width, rngs=rngs) if moves else None
            # After the last offsets nobody reads the embeddings.
            unread = is_last and moves
            self.feed_forward = None if unread else ResidualNetwork(config, width, hidden, rngs=rngs)

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
        after_first, after_second = self.norms[0], self.norms[1]
        e, tokens = self._embedded(embeddings, features, keys[:2])
        basis = tokens[:, :: self.config.cross_attention_basis_stride]
        read_first = e if self.config.first_attention is AttentionKeys.QUERIES else basis
        e = after_first(e + self.self_attention(e, read_first, keys[2]))
        e = after_second(e + self.cross_attention(e, basis, keys[3]))
        e = self._read_points(e, queries, tokens, surroundings)
        return self._moved(e, queries, keys[4])

    def _embedded(self, embeddings: Array, features: Array, keys: list) -> tuple[Array, Array]:
        if self.embed is None:
            return embeddings, features
        rate = self.config.dropout
        return dropout(self.embed(embeddings), rate, keys[0]), dropout(self.embed(features), rate, keys[1])

    def _read_points(self, e: Array, queries: Array, features: Array, surroundings: Surroundings) -> Array:
        if isinstance(self.vector_attention, QueriesThenBasis):
            return self.vector_attention(e, queries, features, surroundings)
        return self.norms[2](e + self.vector_attention(e, queries, features, surroundings.basis))

    def _moved(self, e: Array, queries: Array, key: PRNGKeyArray | None) -> tuple[Array, Array]:
        if isinstance(self.feed_forward, OffsetNetwork):
            return e, queries + self.feed_forward(e)
        if self.branch is not None:
            queries = queries + self.branch(e)
        return e if self.feed_forward is None else self.feed_forward(e, key), queries


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

    def __init__(self, config: DecoderConfig, width: int, hidden: int, *, rngs: nnx.Rngs) -> None:
        self.dropout_rate = config.dropout
        self.hidden, self.out = linear(width, hidden, rngs=rngs), linear(hidden, width, rngs=rngs)
        self.norm = layer_norm(width, config.layer_norm_epsilon, rngs=rngs)

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
    ) -> Float[Array, "batch query c"]:
        """Let every query read all tokens; in training some of the weights and results are dropped."""
        q, k, v = (
            self._heads(layer(x))
            for layer, x in ((self.query, queries), (self.key, tokens), (self.value, tokens))
        )
        if dropout_key is None:
            keys, out_key = None, None
        else:
            weights_key, out_key = jax.random.split(dropout_key)
            keys = jax.random.split(weights_key, len(q))
        attend = functools.partial(_attend, dropout_rate=self.dropout_rate)
        # One head of one sample at a time, recomputed in the backward pass: no array is larger than its map,
        # and each product is one plain matrix product, several times faster on a CPU than with heads inside.
        read = jax.lax.map(jax.checkpoint(attend), (q, k, v, keys))  # pyright: ignore[reportPrivateImportUsage]
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
    arguments: tuple[Array, Array, Array, PRNGKeyArray | None], *, dropout_rate: float
) -> Float[Array, "query c"]:
    """Let the queries of one head read its tokens."""
    q, k, v, key = arguments
    logits = (q * q.shape[-1] ** -0.5) @ k.T
    weights = jnp.exp(logits - jax.lax.stop_gradient(jnp.max(logits, -1, keepdims=True)))
    total = jnp.sum(weights, -1, keepdims=True)
    # Divided last: the map is passed over once less.
    return (dropout(weights, dropout_rate, key) @ v) / total
