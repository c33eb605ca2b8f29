"""Multi-head scalar attention (paper, eq. 10)."""

import functools

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.linear import Linear, dropout
from poem_jax.typing import Array, Float, PRNGKeyArray


class MultiHeadAttention(nnx.Module):
    """softmax(Q K^T / sqrt(d / heads)) V, projected."""

    def __init__(self, width: int, num_heads: int, *, dropout_rate: float = 0.0, rngs: nnx.Rngs) -> None:
        self.num_heads, self.dropout_rate = num_heads, dropout_rate
        self.query, self.key, self.value, self.out = (Linear(width, width, rngs=rngs) for _ in range(4))

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
