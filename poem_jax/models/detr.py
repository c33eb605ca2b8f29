"""Decoder of DETR (Carion et al. 2020): embeddings read each other, then the image tokens of all views.

Paper, section "Main experiments", PE-MeshTR and FTL-MeshTR; also POEM v1 without its Point-Embedded
Transformer. Unlike the layers of `decoder.py` it knows no coordinates: places are told by codes, which are
added to what queries and keys are made of, never to the values.
"""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.decoder import PAPER_EPSILON, MultiHeadAttention
from poem_jax.models.detr_config import DetrConfig
from poem_jax.models.layers import DecoderRow, dropout, layer_norm, linear
from poem_jax.typing import Array, Bool, Float, PRNGKeyArray


class DetrDecoder(DecoderRow):
    """A row of layers, and one layer norm through which the embeddings pass where they are read out."""

    def __init__(self, config: DetrConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.layers = nnx.List(DetrLayer(config, width, rngs=rngs) for _ in range(config.num_layers))
        self.norm = layer_norm(width, PAPER_EPSILON, rngs=rngs)

    def __call__(
        self,
        query_codes: Float[Array, "batch query c"],
        tokens: Float[Array, "batch token c"],
        token_codes: Float[Array, "batch token c"] | None,
        token_mask: Bool[Array, "batch token"],
        dropout_key: PRNGKeyArray | None = None,
    ) -> Float[Array, "batch layer query c"]:
        """Return the embeddings after every layer, normalised; they start at zero.

        Args:
            query_codes: what tells the queries apart (the paper's query embeddings).
            tokens: cells of the feature maps of all views, in any order.
            token_codes: their positions, read through the keys alone; None = the tokens hold them.
            token_mask: True = a token that may be read. A sample without any gets finite embeddings that mean
                nothing.
            dropout_key: in training; None drops nothing.
        """
        embeddings, read_out = jnp.zeros_like(query_codes), []
        keys = tokens if token_codes is None else tokens + token_codes
        for i, layer in enumerate(self.layers):
            key = None if dropout_key is None else jax.random.fold_in(dropout_key, i)
            embeddings = self.run(layer, embeddings, query_codes, keys, tokens, token_mask, key)
            read_out.append(self.norm(embeddings))
        return jnp.stack(read_out, 1)


class DetrLayer(nnx.Module):
    """Self-attention, cross-attention and feed-forward network, a layer norm after each sum."""

    def __init__(self, config: DetrConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.dropout_rate = config.dropout
        self.self_attention, self.cross_attention = (
            MultiHeadAttention(width, config.num_heads, dropout_rate=config.dropout, rngs=rngs)
            for _ in range(2)
        )
        self.hidden = linear(width, config.ffn_width, rngs=rngs)
        self.out = linear(config.ffn_width, width, rngs=rngs)
        self.norms = nnx.List(layer_norm(width, PAPER_EPSILON, rngs=rngs) for _ in range(3))

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        query_codes: Float[Array, "batch query c"],
        keys: Float[Array, "batch token c"],
        values: Float[Array, "batch token c"],
        token_mask: Bool[Array, "batch token"],
        dropout_key: PRNGKeyArray | None = None,
    ) -> Float[Array, "batch query c"]:
        """Return the updated embeddings."""
        after_self, after_cross, after_network = self.norms
        drop = [None] * 4 if dropout_key is None else list(jax.random.split(dropout_key, 4))
        x = embeddings
        placed = x + query_codes
        x = after_self(x + self.self_attention(placed, placed, drop[0], values=x))
        read = self.cross_attention(x + query_codes, keys, drop[1], values=values, token_mask=token_mask)
        x = after_cross(x + read)
        hidden = dropout(jax.nn.relu(self.hidden(x)), self.dropout_rate, drop[2])
        return after_network(x + dropout(self.out(hidden), self.dropout_rate, drop[3]))
