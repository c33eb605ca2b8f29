"""Nearest neighbours among points, and gathers by their indices."""

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.typing import Array, Float, Int, Num

_GROUP = 8
"""Points per group of the two-stage search."""
_QUERIES_AT_A_TIME = 1024
"""Queries that are searched together: of more, the distances to all points would fill the memory."""


def nearest(
    queries: Float[Array, "*batch query 3"], points: Float[Array, "*batch point 3"], k: int
) -> Int[Array, "*batch query k"]:
    """Return the indices of the k points nearest to each query, nearest first; not differentiated.

    The k nearest points lie in the k groups whose nearest members are nearest, so a first selection among
    groups leaves few candidates for the second; the result is exact.

    Raises: ValueError: k is not in 1..point.
    """
    num_points = points.shape[-2]
    if not 1 <= k <= num_points:
        raise ValueError(f"`k` must be between 1 and the number of points = {num_points}; got {k}")
    queries, points = jax.lax.stop_gradient(queries), jax.lax.stop_gradient(points)
    part, rest = divmod(queries.shape[-2], _QUERIES_AT_A_TIME)
    if part <= 1 or rest:
        return _nearest(queries, points, k)
    parts = jnp.moveaxis(queries.reshape(*queries.shape[:-2], part, _QUERIES_AT_A_TIME, 3), -3, 0)
    found = jax.lax.map(lambda some: _nearest(some, points, k), parts)
    return jnp.moveaxis(found, 0, -3).reshape(*queries.shape[:-1], k)


def _nearest(queries: Array, points: Array, k: int) -> Int[Array, "*batch query k"]:
    num_points = points.shape[-2]
    negated = -_squared_distances(queries, points)
    if num_points % _GROUP or num_points < 4 * _GROUP * k:
        return jax.lax.top_k(negated, k)[1]
    groups = negated.reshape(*negated.shape[:-1], num_points // _GROUP, _GROUP)
    chosen = jax.lax.top_k(jnp.max(groups, axis=-1), k)[1]
    candidates = jnp.take_along_axis(groups, chosen[..., None], axis=-2)
    best = jax.lax.top_k(candidates.reshape(*chosen.shape[:-1], k * _GROUP), k)[1]
    group = jnp.take_along_axis(chosen, best // _GROUP, axis=-1)
    return group * _GROUP + best % _GROUP


def farthest_points(points: Float[np.ndarray, "point 3"], k: int) -> Int[np.ndarray, " k"]:
    """Return k indices that spread over the points: 0, then always the point farthest from those taken."""
    taken, gap = [0], np.full(len(points), np.inf)
    for _ in range(k - 1):
        gap = np.minimum(gap, np.sum((points - points[taken[-1]]) ** 2, -1))
        taken.append(int(np.argmax(gap)))
    return np.array(taken, np.int32)


def gather(
    features: Num[Array, "*batch point c"], indices: Int[Array, "*batch query k"]
) -> Num[Array, "*batch query k c"]:
    """Return the features of each query's neighbours; indices must be in range."""
    batch, (query, k), c = indices.shape[:-2], indices.shape[-2:], features.shape[-1]
    rows = features.reshape(-1, *features.shape[-2:])
    flat = indices.reshape(-1, query * k)
    taken = jax.vmap(lambda f, i: f.at[i].get(mode="promise_in_bounds"))(rows, flat)
    return taken.reshape(*batch, query, k, c)


def _squared_distances(queries: Array, points: Array) -> Array:
    """Return (*batch, query, point), summed over unrolled coordinates: on CPU twice as fast as a product."""
    differences = [queries[..., :, None, i] - points[..., None, :, i] for i in range(3)]
    return sum(d * d for d in differences)  # pyright: ignore[reportReturnType]
