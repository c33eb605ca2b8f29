import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models.aggregation import ProjectiveAggregation, row_major_tokens
from poem_jax.models.config import AggregationConfig, Design, Similarity

BATCH, VIEWS, POINTS, WIDTH = 3, 4, 5, 8
FEATURES = np.random.default_rng(0).normal(size=(BATCH, VIEWS, POINTS, WIDTH)).astype(np.float32)
MASK = np.array([[True] * 4, [False, True, True, False], [False, False, True, False]])
PRIMARY = np.array([0, 1, 2])


def _module(similarity):
    return ProjectiveAggregation(AggregationConfig(similarity=similarity), WIDTH, rngs=nnx.Rngs(0))


@pytest.fixture(params=list(Similarity))
def module(request):
    return _module(request.param)


@pytest.fixture(params=[Similarity.DOT, Similarity.MEAN])
def projective(request):
    return _module(request.param)


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


def test_equation_8(projective):
    expected = _naive(projective, FEATURES, MASK, PRIMARY)
    np.testing.assert_allclose(projective(FEATURES, MASK, PRIMARY), expected, atol=1e-5)


def test_one_view_passes_exactly(projective):
    np.testing.assert_array_equal(projective(FEATURES, MASK, PRIMARY)[2], FEATURES[2, 2])


def test_without_a_similarity_all_views_are_alike():
    module, order = _module(Similarity.EQUAL), np.array([2, 0, 3, 1])
    fused = module(FEATURES, MASK, PRIMARY)
    np.testing.assert_allclose(fused, module(FEATURES[:, order], MASK[:, order], PRIMARY), atol=1e-6)
    doubled = np.concatenate([FEATURES, FEATURES], 1), np.concatenate([MASK, MASK], 1)
    np.testing.assert_allclose(fused, module(*doubled, PRIMARY), atol=1e-6)
    for sample, valid in enumerate(MASK):
        f = FEATURES[sample, valid]
        theta = np.asarray(module.theta_out(np.maximum(module.theta_in(f), 0))).mean(0)
        expected = f.mean(0) + np.asarray(module.phi_out(np.maximum(module.phi_in(theta), 0)))
        np.testing.assert_allclose(fused[sample], expected, atol=1e-6)


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


def test_row_major_tokens_read_the_memory_of_the_valid_views():
    """As the released code reshapes it: (N, C, S) contiguous, taken for (S, N, C)."""
    count = np.array([4, 2, 3])
    tokens = np.asarray(row_major_tokens(jnp.asarray(FEATURES), jnp.asarray(count)))
    for sample, n in enumerate(count):
        memory = np.ascontiguousarray(FEATURES[sample, :n].transpose(0, 2, 1))
        expected = memory.reshape(POINTS, n, WIDTH)
        np.testing.assert_array_equal(tokens[sample, :n].transpose(1, 0, 2), expected)


def test_one_view_gets_the_residual_of_the_release():
    config = AggregationConfig(design=Design.RELEASE)
    module = ProjectiveAggregation(config, WIDTH, rngs=nnx.Rngs(0))
    assert module.phi_in.kernel.shape == (WIDTH // 2, WIDTH // 2)
    alone = FEATURES[2:, 2:3]
    f1 = np.asarray(row_major_tokens(jnp.asarray(alone), np.ones(1, int)))[0, 0]
    theta = module.theta_out(np.maximum(module.theta_in(f1), 0))
    expected = f1 + module.phi_out(np.maximum(module.phi_in(theta), 0))
    found = module(alone, np.ones((1, 1), bool), np.zeros(1, int))
    np.testing.assert_allclose(found[0], expected, atol=1e-6)


def test_masked_views_do_not_matter_to_the_row_major_layout():
    config = AggregationConfig(design=Design.RELEASE)
    module = ProjectiveAggregation(config, WIDTH, rngs=nnx.Rngs(0))
    mask = np.array([[True] * 4, [True, True, False, False], [True, False, False, False]])
    found = module(FEATURES, mask, np.zeros(3, int))
    for sample, n in enumerate((4, 2, 1)):
        alone = module(FEATURES[sample : sample + 1, :n], np.ones((1, n), bool), np.zeros(1, int))
        np.testing.assert_allclose(found[sample : sample + 1], alone, atol=1e-6)
