"""Presets are built abstractly: no weights are drawn."""

import jax
import pytest

from poem_jax.models.config import Config
from poem_jax.models.network import describe
from poem_jax.models.presets import PRESETS, preset


def _count(tree) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize(
    ("name", "trainable"),
    [
        ("v2-small", 48_311_066),
        ("v2-base", 51_239_642),
        ("v2-large", 62_700_122),
        ("v2-param", 51_001_441),
    ],
)
def test_parameter_counts(name, trainable):
    assert _count(describe(preset(name))["trainable"]) == trainable


def test_tiny_fits_into_the_package():
    params = describe(preset("tiny"))
    assert 4 * _count(params) < 25e6


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_groups_and_layout(name):
    config = preset(name)
    params = describe(config)
    assert set(params) == {"trainable", "statistics", "constants"}
    if isinstance(config, Config):
        assert params["constants"]["basis_points"].shape == (config.basis.num_points, 3)
        assert params["constants"]["template_queries"].shape == (799, 3)
    assert params["constants"]["hand"]["faces"].shape == (1538, 3)
    for path, _ in jax.tree_util.tree_leaves_with_path(params):
        assert all(isinstance(part, jax.tree_util.DictKey) and isinstance(part.key, str) for part in path)
