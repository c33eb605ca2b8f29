import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry import neighbours
from poem_jax.geometry.neighbours import gather, nearest

nearest_jit = jax.jit(nearest, static_argnums=2)


def _naive(queries: np.ndarray, points: np.ndarray, k: int) -> np.ndarray:
    distances = np.linalg.norm(queries[..., :, None, :] - points[..., None, :, :], axis=-1)
    return np.argsort(distances, axis=-1)[..., :k]


@pytest.mark.parametrize(("num_points", "k"), [(7, 1), (7, 7), (50, 4), (256, 4), (1024, 32)])
def test_equals_sorting(rng, x64, num_points, k):
    # 256 with 4 and 1024 with 32 take the two-stage search.
    queries, points = rng.normal(size=(2, 9, 3)), rng.normal(size=(2, num_points, 3))
    np.testing.assert_array_equal(nearest_jit(queries, points, k), _naive(queries, points, k))


def test_batch_axes_and_jit(rng, batch):
    queries = rng.normal(size=(*batch, 5, 3)).astype(np.float32)
    points = rng.normal(size=(*batch, 64, 3)).astype(np.float32)
    result = nearest_jit(queries, points, 2)
    assert result.shape == (*batch, 5, 2)
    np.testing.assert_array_equal(result, _naive(queries, points, 2))
    if len(batch) == 1:
        np.testing.assert_array_equal(result, nearest(queries, points, 2))
        np.testing.assert_array_equal(result, jax.vmap(lambda q, p: nearest(q, p, 2))(queries, points))


def test_duplicates_still_give_distinct_neighbours():
    points = np.zeros((256, 3), np.float32)
    chosen = np.asarray(nearest_jit(points[:3], points, 4))
    assert all(len(set(row)) == 4 for row in chosen.tolist())


def test_permuting_points_permutes_neighbours(rng):
    queries, points = rng.normal(size=(5, 3)).astype(np.float32), rng.normal(size=(64, 3)).astype(np.float32)
    order = rng.permutation(64)
    permuted = order[np.asarray(nearest_jit(queries, points[order], 2))]
    np.testing.assert_array_equal(permuted, nearest_jit(queries, points, 2))


@pytest.mark.parametrize("k", [0, 6])
def test_k_out_of_range(rng, k):
    with pytest.raises(ValueError, match=f"`k` must be between 1 and the number of points = 5; got {k}"):
        nearest(rng.normal(size=(2, 3)), rng.normal(size=(5, 3)), k)


def test_gather_takes_rows(rng, batch):
    features = rng.normal(size=(*batch, 8, 3)).astype(np.float32)
    indices = rng.integers(0, 8, (*batch, 5, 2))
    result = gather(jnp.asarray(features), jnp.asarray(indices))
    assert result.shape == (*batch, 5, 2, 3)
    for index in np.ndindex(*batch):
        np.testing.assert_array_equal(result[index], features[index][indices[index]])


def test_gather_gradients_and_search_without(rng, check_gradients):
    points = rng.normal(size=(64, 3))
    check_gradients(lambda p: gather(p, nearest(p[:5], p, 2)), points)


def test_many_queries_are_searched_part_by_part(rng, monkeypatch):
    monkeypatch.setattr(neighbours, "_QUERIES_AT_A_TIME", 8)
    queries, points = (rng.normal(size=(2, 3, n, 3)).astype(np.float32) for n in (24, 50))
    np.testing.assert_array_equal(nearest(queries, points, 5), _naive(queries, points, 5))
