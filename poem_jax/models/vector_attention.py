"""Vector attention of query points over their nearest basis points (paper, eq. 11; Zhao et al. 2021).

    E_i <- sum_j softmax_j(gamma(alpha(E_i) - beta(F_j) + delta_ij)) * (psi(F_j) + delta_ij),
    delta_ij = xi(X_i - P_j), j over the k nearest basis points; softmax and product per channel.

gamma and xi are two-layer networks. Their linear parts commute with the gather, so with G = gamma_1 and
h_ij = relu(xi_1(X_i - P_j)) what is linear is applied to points before gathering, and G xi_2 is one matrix:

    logits_ij = gamma_2(relu(G alpha(E_i) - G beta(F_j) + G xi_2 h_ij)),    values_ij = psi(F_j) + xi_2 h_ij.

The neighbours are visited in a loop, each visit recomputed in the backward pass, so that no (query, k, c)
array is kept.
"""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.linear import Linear
from poem_jax.typing import Array, Float, Int

_MAX_LOGIT = 60.0
"""Logits are taken relative to those of the nearest neighbour; exp(60) is far from overflow in float32."""


class VectorAttention(nnx.Module):
    """The five embedding networks alpha, beta, gamma, psi, xi."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.alpha, self.beta, self.psi = (Linear(width, width, bias=False, rngs=rngs) for _ in range(3))
        self.gamma_in = Linear(width, width, rngs=rngs)
        # No bias: a constant over the softmax's axis has no effect.
        self.gamma_out = Linear(width, width, bias=False, rngs=rngs)
        self.xi_in, self.xi_out = Linear(3, width, rngs=rngs), Linear(width, width, rngs=rngs)

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        points: Float[Array, "basis 3"],
        neighbours: Int[Array, "batch query k"],
    ) -> Float[Array, "batch query c"]:
        """Read the neighbours' features; coordinates in units of the basis radius."""
        gamma = self.gamma_in.kernel[...]
        per_query = self.gamma_in(self.alpha(embeddings) + self.xi_out.bias[...])
        per_point = features @ jnp.concatenate([self.beta.kernel[...] @ gamma, self.psi.kernel[...]], -1)
        from_offset = jnp.concatenate([self.xi_out.kernel[...] @ gamma, self.xi_out.kernel[...]], -1)

        def visit(index: Int[Array, "batch query"]) -> tuple[Array, Array]:
            """Return the logits and the values of one neighbour of every query."""
            beta, psi = jnp.split(_rows(per_point, index), 2, -1)
            offset = queries - jnp.asarray(points)[index]
            delta_in, delta = jnp.split(jax.nn.relu(self.xi_in(offset)) @ from_offset, 2, -1)
            logits = self.gamma_out(jax.nn.relu(per_query - beta + delta_in))
            return logits, psi + delta

        values = _softmax_sum(visit, jnp.moveaxis(neighbours, -1, 0))
        return values + self.xi_out.bias[...]


def _rows(
    table: Float[Array, "batch basis c"], index: Int[Array, "batch query"]
) -> Float[Array, "batch query c"]:
    return jax.vmap(lambda rows, i: rows.at[i].get(mode="promise_in_bounds"))(table, index)


def _softmax_sum(visit, indices: Int[Array, "k batch query"]) -> Float[Array, "batch query c"]:
    """Return sum_j softmax_j(logits) * values over the visits.

    A softmax may be taken relative to any reference; the nearest neighbour's logits serve, so that the sums
    need no first pass for a maximum and the denominator is at least 1.
    """
    reference = jax.lax.stop_gradient(visit(indices[0])[0])

    @jax.checkpoint  # pyright: ignore[reportPrivateImportUsage]
    def weighted(index: Array) -> tuple[Array, Array]:
        logits, values = visit(index)
        weight = jnp.exp(jnp.minimum(logits - reference, _MAX_LOGIT))
        return weight, weight * values

    def add(sums: tuple[Array, Array], index: Array) -> tuple[tuple[Array, Array], None]:
        return jax.tree.map(jnp.add, sums, weighted(index)), None

    zero = jnp.zeros_like(reference)
    (denominator, numerator), _ = jax.lax.scan(add, (zero, zero), indices)
    return numerator / denominator
