"""Multi-head scalar attention (paper, eq. 10)."""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.linear import Linear
from poem_jax.typing import Array, Float


class MultiHeadAttention(nnx.Module):
    """softmax(Q K^T / sqrt(d / heads)) V, projected."""

    def __init__(self, width: int, num_heads: int, *, rngs: nnx.Rngs) -> None:
        self.num_heads = num_heads
        self.query, self.key, self.value, self.out = (Linear(width, width, rngs=rngs) for _ in range(4))

    def __call__(
        self, queries: Float[Array, "batch query c"], tokens: Float[Array, "batch token c"]
    ) -> Float[Array, "batch query c"]:
        """Let every query read all tokens."""
        q, k, v = (
            layer(x).reshape(*x.shape[:-1], self.num_heads, -1)
            for layer, x in ((self.query, queries), (self.key, tokens), (self.value, tokens))
        )
        # One sample at a time, recomputed in the backward pass: no array is larger than this map.
        read = jax.lax.map(jax.checkpoint(_attend), (q, k, v))  # pyright: ignore[reportPrivateImportUsage]
        return self.out(read.reshape(queries.shape))


def _attend(qkv: tuple[Array, Array, Array]) -> Float[Array, "query head c"]:
    q, k, v = qkv
    logits = jnp.einsum("qhc,thc->hqt", q / jnp.sqrt(jnp.array(q.shape[-1], q.dtype)), k)
    return jnp.einsum("hqt,thc->qhc", jax.nn.softmax(logits), v)
