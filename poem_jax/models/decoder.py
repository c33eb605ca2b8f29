"""Point-embedded Transformer decoder: query points read the basis points and move.

Paper, section "Point-Embedded Transformer Decoder".

Coordinates are in units of the basis radius, about the root.
"""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.geometry.neighbours import nearest
from poem_jax.hand.topology import NUM_QUERIES
from poem_jax.models.attention import MultiHeadAttention
from poem_jax.models.config import DecoderConfig, DecoderOutput, NeighbourSearch
from poem_jax.models.linear import LayerNorm, Linear, zeros
from poem_jax.models.vector_attention import VectorAttention
from poem_jax.typing import Array, Float, Int


class Decoder(nnx.Module):
    """Learned query embeddings and a row of layers that each move the query points."""

    def __init__(self, config: DecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.embeddings = nnx.Param(jax.random.normal(rngs.params(), (NUM_QUERIES, width)))
        moving = config.num_layers - (config.output is DecoderOutput.HAND_PARAMETERS)
        self.layers = nnx.List(
            DecoderLayer(config, width, moves=i < moving, rngs=rngs) for i in range(config.num_layers)
        )
        self.locate = CoordinateEmbedding(width, rngs=rngs) if config.embed_coordinates else None

    def __call__(
        self,
        queries: Float[Array, "batch query 3"],
        points: Float[Array, "basis 3"],
        features: Float[Array, "batch basis c"],
    ) -> tuple[list[Float[Array, "batch query 3"]], Float[Array, "batch query c"]]:
        """Return the query points after every layer that moves them, and the last embeddings."""
        embeddings = jnp.broadcast_to(self.embeddings[...], (*queries.shape[:-1], features.shape[-1]))
        if self.locate is not None:
            features = features + self.locate(points)
        neighbours, moved = self._neighbours(queries, points), []
        for layer in self.layers:
            if moved and self.config.neighbour_search is NeighbourSearch.EVERY_LAYER:
                neighbours = self._neighbours(queries, points)
            if self.locate is not None:
                embeddings = embeddings + self.locate(queries)
            embeddings, queries = layer(embeddings, queries, points, features, neighbours)
            moved.append(queries)
        return moved[: len(moved) - (self.config.output is DecoderOutput.HAND_PARAMETERS)], embeddings

    def _neighbours(self, queries: Array, points: Array) -> Int[Array, "batch query k"]:
        shared = jnp.broadcast_to(points, (queries.shape[0], *points.shape))
        return nearest(queries, shared, self.config.num_neighbours)


class DecoderLayer(nnx.Module):
    """Self-attention, cross-attention, vector attention, and a feed-forward network that moves the points."""

    def __init__(self, config: DecoderConfig, width: int, *, moves: bool, rngs: nnx.Rngs) -> None:
        self.basis_stride = config.cross_attention_basis_stride
        self.self_attention = MultiHeadAttention(width, config.num_heads, rngs=rngs)
        self.cross_attention = MultiHeadAttention(width, config.num_heads, rngs=rngs)
        self.vector_attention = VectorAttention(width, rngs=rngs)
        self.norms = nnx.List(LayerNorm(width) for _ in range(3))
        self.feed_forward = FeedForward(width, config.ffn_expansion * width, rngs=rngs) if moves else None

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        points: Float[Array, "basis 3"],
        features: Float[Array, "batch basis c"],
        neighbours: Int[Array, "batch query k"],
    ) -> tuple[Float[Array, "batch query c"], Float[Array, "batch query 3"]]:
        """Return the updated embeddings and points."""
        after_self, after_cross, after_vector = self.norms
        e = after_self(embeddings + self.self_attention(embeddings, embeddings))
        e = after_cross(e + self.cross_attention(e, features[:, :: self.basis_stride]))
        e = after_vector(e + self.vector_attention(e, queries, features, points, neighbours))
        return e, queries if self.feed_forward is None else queries + self.feed_forward(e)


class FeedForward(nnx.Module):
    """Two layers from embedding to offset; zero at first, so that learning starts from the template."""

    def __init__(self, width: int, hidden: int, *, rngs: nnx.Rngs) -> None:
        self.hidden = Linear(width, hidden, rngs=rngs)
        self.offset = Linear(hidden, 3, init=zeros, rngs=rngs)

    def __call__(self, embeddings: Float[Array, "batch query c"]) -> Float[Array, "batch query 3"]:
        """Regress offsets."""
        return self.offset(jax.nn.relu(self.hidden(embeddings)))


class CoordinateEmbedding(nnx.Module):
    """Two layers from a coordinate to an embedding."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.hidden, self.out = Linear(3, width, rngs=rngs), Linear(width, width, rngs=rngs)

    def __call__(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch c"]:
        """Embed."""
        return self.out(jax.nn.relu(self.hidden(points)))
