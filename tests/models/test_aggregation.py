import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models.aggregation import ProjectiveAggregation
from poem_jax.models.config import Similarity

BATCH, VIEWS, POINTS, WIDTH = 3, 4, 5, 8
FEATURES = np.random.default_rng(0).normal(size=(BATCH, VIEWS, POINTS, WIDTH)).astype(np.float32)
MASK = np.array([[True] * 4, [False, True, True, False], [False, False, True, False]])
PRIMARY = np.array([0, 1, 2])


@pytest.fixture(params=list(Similarity))
def module(request):
    return ProjectiveAggregation(WIDTH, request.param, rngs=nnx.Rngs(0))


def _naive(module, features, mask, primary):
    scale = 2 / WIDTH if module.similarity_scale != 1 else 1

    def theta(f):
        return np.asarray(module.theta_out(np.maximum(module.theta_in(f), 0)))

    fused = []
    for sample in range(len(features)):
        valid = np.flatnonzero(mask[sample])
        f1 = features[sample, primary[sample]]
        rows = []
        for point in range(POINTS):
            t1, total = theta(f1[point]), np.zeros(WIDTH // 2, np.float32)
            for j in valid[1:]:
                tj = theta(features[sample, j, point])
                total += scale * (t1 @ tj) * tj
            update = np.asarray(module.phi_out(np.maximum(module.phi_in(total), 0)))
            rows.append(f1[point] + (update / len(valid) if len(valid) > 1 else 0))
        fused.append(rows)
    return np.array(fused)


def test_equation_8(module):
    expected = _naive(module, FEATURES, MASK, PRIMARY)
    np.testing.assert_allclose(module(FEATURES, MASK, PRIMARY), expected, atol=1e-5)


def test_one_view_passes_exactly(module):
    np.testing.assert_array_equal(module(FEATURES, MASK, PRIMARY)[2], FEATURES[2, 2])


def test_masked_views_do_not_matter(module):
    changed = np.where(MASK[..., None, None], FEATURES, 1e3).astype(np.float32)
    np.testing.assert_allclose(module(FEATURES, MASK, PRIMARY), module(changed, MASK, PRIMARY), atol=1e-6)


def test_source_views_are_a_set(module):
    order = np.array([0, 3, 1, 2])
    np.testing.assert_allclose(
        module(FEATURES, MASK, PRIMARY)[:1], module(FEATURES[:1, order], MASK[:1], PRIMARY[:1]), atol=1e-5
    )


def test_permuted_points_permute_their_features(module):
    order = np.random.default_rng(1).permutation(POINTS)
    permuted = module(jnp.asarray(FEATURES)[:, :, order], MASK, PRIMARY)
    np.testing.assert_allclose(permuted, module(FEATURES, MASK, PRIMARY)[:, order], atol=1e-6)
