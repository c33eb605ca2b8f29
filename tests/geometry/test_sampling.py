import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.sampling import sample_bilinear, sample_levels, soft_argmax


def _naive(feature_map: np.ndarray, u: float, v: float) -> np.ndarray:
    """Every cell with its tent weight."""
    h, w, c = feature_map.shape
    total = np.zeros(c)
    for i in range(h):
        for j in range(w):
            total += max(0, 1 - abs(u - j - 0.5)) * max(0, 1 - abs(v - i - 0.5)) * feature_map[i, j]
    return total


def test_equals_the_naive_form_inside_and_outside(rng, x64):
    feature_map = rng.normal(size=(4, 6, 3))
    uv = rng.uniform(-2, 8, (60, 2))
    uv[:4] = [[0, 0], [6, 4], [0.5, 0.5], [5.5, 3.5]]
    expected = [_naive(feature_map, *p) for p in uv]
    np.testing.assert_allclose(jax.jit(sample_bilinear)(feature_map, uv), expected, atol=1e-12)


def test_cell_centres_return_the_cells(rng):
    feature_map = rng.normal(size=(3, 5, 2)).astype(np.float32)
    v, u = np.meshgrid(np.arange(3) + 0.5, np.arange(5) + 0.5, indexing="ij")
    uv = np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)
    np.testing.assert_array_equal(sample_bilinear(feature_map, uv), feature_map.reshape(-1, 2))


def test_batch_axes(rng, batch):
    feature_map = rng.normal(size=(*batch, 4, 6, 3)).astype(np.float32)
    uv = rng.uniform(-1, 7, (*batch, 5, 2)).astype(np.float32)
    result = jax.jit(sample_bilinear)(feature_map, uv)
    assert result.shape == (*batch, 5, 3)
    for index in np.ndindex(*batch):
        np.testing.assert_allclose(result[index], sample_bilinear(feature_map[index], uv[index]), atol=1e-6)


def test_gradients_equal_finite_differences(rng, check_gradients):
    uv = np.concatenate([rng.uniform(0, 6, (8, 2)), rng.uniform(-2, 0, (3, 2))])
    check_gradients(sample_bilinear, rng.normal(size=(4, 6, 3)), uv)


@pytest.mark.parametrize("far", [1e9, -1e9, 3e38, np.inf, -np.inf])
def test_far_away_is_zero_with_zero_gradient(rng, far):
    feature_map = rng.normal(size=(4, 6, 3)).astype(np.float32)
    uv = np.asarray([[far, 1.0], [1.0, far], [far, far]], np.float32)
    value = jax.jit(sample_bilinear)(feature_map, uv)
    np.testing.assert_array_equal(value, 0)
    total = jax.jit(jax.grad(lambda f, x: jnp.sum(sample_bilinear(f, x)), argnums=(0, 1)))
    for gradient in total(feature_map, uv):
        np.testing.assert_array_equal(gradient, 0)


def test_soft_argmax_finds_single_cells_and_scales_out(rng, batch):
    heatmap = np.zeros((*batch, 4, 6), np.float32)
    heatmap[..., 1, 4] = 0.3
    np.testing.assert_allclose(jax.jit(soft_argmax)(heatmap), np.broadcast_to([4.5, 1.5], (*batch, 2)))
    heatmap = rng.uniform(size=(*batch, 4, 6)).astype(np.float32)
    np.testing.assert_allclose(soft_argmax(heatmap), soft_argmax(7 * heatmap), rtol=1e-5)
    np.testing.assert_allclose(soft_argmax(np.ones((4, 6), np.float32)), [3, 2], rtol=1e-6)


def test_soft_argmax_gradients(rng, check_gradients):
    check_gradients(soft_argmax, rng.uniform(size=(2, 4, 6)))
    empty = jnp.zeros((4, 6))
    np.testing.assert_array_equal(soft_argmax(empty), [3, 2])
    assert np.isfinite(jax.jit(jax.jacobian(soft_argmax))(empty)).all()


def test_levels_are_read_as_each_alone():
    rng = np.random.default_rng(0)
    maps = [rng.normal(size=(2, 3, h, w, 5)).astype(np.float32) for h, w in ((2, 3), (4, 6), (7, 5))]
    uv_share = rng.uniform(-0.5, 1.5, (2, 3, 3, 40, 2)).astype(np.float32)
    uv_share[0, 0, :, 0] = np.inf
    together = sample_levels(maps, uv_share)
    for i, x in enumerate(maps):
        alone = sample_bilinear(x, uv_share[:, :, i] * np.array(x.shape[-3:-1][::-1], np.float32))
        np.testing.assert_allclose(together[:, :, i], alone, rtol=0, atol=1e-6)
