"""Vector attention of query points over neighbouring points (paper, eq. 11; Zhao et al. 2021).

    E_i <- sum_j softmax_j(gamma(alpha(E_i) - beta(F_j) + delta_ij)) * (psi(F_j) + delta_ij),
    delta_ij = xi(X_i - P_j), j over the neighbours of i; softmax and product per channel.

gamma and xi are two-layer networks. Their linear parts commute with the gather, so with G = gamma_1 and
h_ij = relu(xi_1(X_i - P_j)) what is linear is applied to points before gathering, and G xi_2 is one matrix:

    logits_ij = gamma_2(relu(G alpha(E_i) - G beta(F_j) + G xi_2 h_ij)),    values_ij = psi(F_j) + xi_2 h_ij.

The neighbours are visited in a loop, each visit recomputed in the backward pass, so that no (query, k, c)
array is kept.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.geometry.neighbours import nearest
from poem_jax.models.layers import at_least_float32, linear
from poem_jax.typing import Array, Bool, Float, Int

_FAR = 1e6
"""Where points that are not to be found stand for the search; coordinates are at most some hundreds."""

_TOGETHER = 8
"""Neighbours that are visited at once where their deltas are known, and the largest batch for which that is
done: programs of inference on a CPU, which it makes faster by a third; others it may slow down."""
_MOST_STEPS = 8
"""Of the visits to groups that are written out one after another; the released models have four."""


class Deltas(NamedTuple):
    """What the offsets to the neighbours contribute: G xi_2 h_ij and xi_2 h_ij."""

    inside: Float[Array, "k batch query c"]
    values: Float[Array, "k batch query c"]


class Neighbours(NamedTuple):
    """Which rows of a point cloud each query reads, and where these stand; neighbours first, for a loop."""

    index: Int[Array, "k batch query"]
    """A query axis of 1 stands for all queries."""
    positions: Float[Array, "k #batch #query 3"]
    deltas: Deltas | None = None
    """Computed beforehand where queries and neighbours never move."""


def nearest_neighbours(
    queries: Float[Array, "batch query 3"],
    points: Float[Array, "batch point 3"],
    k: int,
    point_mask: Bool[Array, "batch point"] | None = None,
) -> Neighbours:
    """Find the `k` points nearest to each query; the search has no derivative, the positions have.

    `point_mask`: True = a point that may be found, None = all; where fewer than `k` may, others fill up.
    """
    searched = points if point_mask is None else jnp.where(point_mask[..., None], points, _FAR)
    index = jnp.moveaxis(nearest(queries, searched, k), -1, 0)
    return Neighbours(index, jax.vmap(_rows, (None, 0))(points, index))


class _Sums(NamedTuple):
    """Of the neighbours visited so far, relative to exp(largest)."""

    largest: Float[Array, "batch query c"]
    denominator: Float[Array, "batch query c"]
    numerator: Float[Array, "batch query c"]


class VectorAttention(nnx.Module):
    """The five embedding networks alpha, beta, gamma, psi, xi."""

    def __init__(self, width: int, *, like_release: bool = False, rngs: nnx.Rngs) -> None:
        """`like_release`: logits are divided by the root of the width, and gamma's last layer has a bias,
        which cannot change anything: it is constant over the softmax's axis."""
        self.alpha, self.beta, self.psi = (linear(width, width, bias=False, rngs=rngs) for _ in range(3))
        self.gamma_in = linear(width, width, rngs=rngs)
        self.gamma_out = linear(width, width, bias=like_release, rngs=rngs)
        self.xi_in, self.xi_out = linear(3, width, rngs=rngs), linear(width, width, rngs=rngs)
        self.logit_scale = width**-0.5 if like_release else 1.0

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch point c"],
        neighbours: Neighbours,
    ) -> Float[Array, "batch query c"]:
        """Read the neighbours' features; coordinates in units of the basis radius."""
        offset = self._offset()
        per_query = self.gamma_in(self.alpha(embeddings) + offset)
        beta, psi = features @ (self.beta.kernel[...] @ self.gamma_in.kernel[...]), self.psi(features)
        to_logits, delta = self.gamma_out.kernel[...] * self.logit_scale, self._delta()

        def visit(neighbour: Neighbours) -> tuple[Array, Array]:
            """Return the logits and the values of one neighbour of every query."""
            known = neighbour.deltas
            added, value = delta(queries, neighbour.positions) if known is None else known
            inside = per_query - _rows(beta, neighbour.index) + added
            return jax.nn.relu(inside) @ to_logits, _rows(psi, neighbour.index) + value

        return _softmax_sum(visit, neighbours) + offset

    def with_deltas(self, queries: Float[Array, "batch query 3"], neighbours: Neighbours) -> Neighbours:
        """Compute beforehand what depends on nothing but the positions."""
        delta = self._delta()
        deltas = jax.lax.map(lambda positions: delta(queries, positions), neighbours.positions)
        return neighbours._replace(deltas=deltas)

    def _offset(self) -> Float[Array, " c"]:
        """Return the part of delta that no position changes."""
        assert self.xi_out.bias is not None
        return self.xi_out.bias[...]

    def _delta(self) -> Callable[[Array, Array], Deltas]:
        """Return the function from queries and the positions of one neighbour each to `Deltas`."""
        xi_out = self.xi_out.kernel[...]
        to_inside = xi_out @ self.gamma_in.kernel[...]

        def delta(queries: Array, positions: Array) -> Deltas:
            hidden = jax.nn.relu(self.xi_in(queries - positions))
            return Deltas(hidden @ to_inside, hidden @ xi_out)

        return delta


class BracketedVectorAttention(nnx.Module):
    """Vector attention between two linear maps, with a residual sum (release)."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.before, self.after = linear(width, width, rngs=rngs), linear(width, width, rngs=rngs)
        self.attention = VectorAttention(width, like_release=True, rngs=rngs)

    def among_queries(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        neighbours: Neighbours,
    ) -> Float[Array, "batch query c"]:
        """Let the queries read each other."""
        mapped = self.before(embeddings)
        return embeddings + self.after(self.attention(mapped, queries, mapped, neighbours))

    def to_basis(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        neighbours: Neighbours,
    ) -> Float[Array, "batch query c"]:
        """Let the queries read basis points; only these pass the first map."""
        read = self.attention(embeddings, queries, self.before(features), neighbours)
        return embeddings + self.after(read)


def _rows(
    table: Float[Array, "batch point c"], index: Int[Array, "batch query"]
) -> Float[Array, "batch query c"]:
    return jax.vmap(lambda rows, i: rows.at[i].get(mode="promise_in_bounds"))(table, index)


def _softmax_sum(visit, neighbours: Neighbours) -> Float[Array, "batch query c"]:
    """Return sum_j softmax_j(logits) * values over the visits.

    The sums are kept relative to the largest logit so far (Milakov and Gimelshein 2018, online softmax),
    which has no derivative: the quotient does not depend on it.
    """

    @jax.checkpoint  # pyright: ignore[reportPrivateImportUsage]
    def add(sums: _Sums, some: Neighbours) -> _Sums:
        return _merged(sums, _sums(*map(at_least_float32, jax.vmap(visit)(some))))

    logits, values = jax.eval_shape(visit, jax.tree.map(lambda leaf: leaf[0], neighbours))
    # Sums of half numbers would lose their digits.
    kept = jnp.promote_types(values.dtype, jnp.float32)
    # Below all logits, so that the first visit counts whole and what was before it not at all.
    least = jnp.full(logits.shape, jnp.finfo(kept).min, kept)
    nothing = _Sums(least, jnp.zeros_like(least), jnp.zeros(values.shape, kept))
    # In a loop the deltas, which are arguments of the program, would be copied before it starts; but a
    # program of hundreds of steps would take an hour, and all memory, to compile.
    few = neighbours.deltas is not None and len(least) <= _TOGETHER
    together = math.gcd(len(neighbours.index), _TOGETHER) if few else 1
    some = jax.tree.map(lambda leaf: leaf.reshape(-1, together, *leaf.shape[1:]), neighbours)
    written_out = few and len(some.index) <= _MOST_STEPS
    sums, _ = jax.lax.scan(lambda sums, some: (add(sums, some), None), nothing, some, unroll=written_out)
    return (sums.numerator / sums.denominator).astype(values.dtype)


def _sums(logits: Float[Array, "some batch query c"], values: Float[Array, "some batch query c"]) -> _Sums:
    """Return the sums over some neighbours alone."""
    largest = jax.lax.stop_gradient(jnp.max(logits, 0))
    if len(logits) == 1:  # exp(0): a constant number with a derivative.
        weight = 1 + (logits[0] - largest)
        return _Sums(largest, weight, weight * values[0])
    weights = jnp.exp(logits - largest)
    return _Sums(largest, jnp.sum(weights, 0), jnp.sum(weights * values, 0))


def _merged(old: _Sums, new: _Sums) -> _Sums:
    """Return the sums over the neighbours of both."""
    rise = new.largest - old.largest
    # One of them is scaled by one, so a single exponential serves both.
    smaller = jnp.exp(-jnp.abs(rise))
    kept, added = jnp.where(rise > 0, smaller, 1), jnp.where(rise > 0, 1, smaller)
    return _Sums(
        jnp.maximum(old.largest, new.largest),
        kept * old.denominator + added * new.denominator,
        kept * old.numerator + added * new.numerator,
    )
