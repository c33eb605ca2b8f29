"""Presets are built abstractly: no weights are drawn."""

import re
from pathlib import Path

import jax
import pytest

from poem_jax.models.config import Config
from poem_jax.models.frustum_config import DepthSteps
from poem_jax.models.network import describe
from poem_jax.models.presets import PRESETS, preset, released


def _count(tree) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


ROOT = Path(__file__).resolve().parents[2]
ROW = re.compile(r"^\| \[`([\w-]+)`\]\(#[\w-]+\) \|[^|]+\| ([\d,]+) \|", re.MULTILINE)


COUNTED = dict(ROW.findall((ROOT / "docs" / "models.md").read_text()))
"""Parameters by preset, in the first table of docs/models.md."""


def test_the_documents_name_every_preset():
    assert set(COUNTED) == set(PRESETS)
    readme = (ROOT / "README.md").read_text()
    assert [name for name in PRESETS if f"`{name}`" not in readme] == []


DATA_SETS = {
    "dexycb": ((-1.2, -1.2, 0.2), (1.2, 1.2, 2.0), 8),
    "ho3d": ((-0.6, -0.6, 0.0), (0.6, 0.6, 1.2), 5),
    "oakink": ((-1.0, -1.0, 0.0), (1.0, 1.0, 1.5), 4),
}
"""The released configs' POSITION_RANGE, whose last axis is that of the grids' depths, and cameras."""


@pytest.mark.parametrize("dataset", DATA_SETS)
def test_released_models_seek_hands_where_their_data_set_has_them(dataset):
    low, high, cameras = DATA_SETS[dataset]
    v1, pe, ftl, mvp = (
        released(variant, dataset=dataset) for variant in ("v1", "pe-meshtr", "ftl-meshtr", "mvp")
    )
    for space in (v1.space, pe.cuboid, ftl.cuboid, mvp.cuboid):
        assert (space.low, space.high) == (low, high)
    depths = (low[2], high[2])
    grids = (v1.basis.frustum, 32, DepthSteps.LINEAR), (pe.fusion.frustum, 64, DepthSteps.LINEAR_INCREASING)
    for grid, count, steps in grids:
        assert (grid.start, grid.end) == depths
        assert (grid.num_depths, grid.steps, grid.cell_offset) == (count, steps, 0.0)
    assert mvp.view_range == (cameras, cameras)


def test_tiny_fits_into_the_package():
    params = describe(preset("tiny"))
    assert 4 * _count(params) < 25e6


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_groups_layout_and_the_documents_count(name):
    config = preset(name)
    params = describe(config)
    assert f"{_count(params['trainable']):,}" == COUNTED[name]
    assert set(params) == {"trainable", "statistics", "constants"}
    if isinstance(config, Config):
        assert params["constants"]["basis_points"].shape == (config.basis.num_points, 3)
        assert params["constants"]["template_queries"].shape == (799, 3)
    assert params["constants"]["hand"]["faces"].shape == (1538, 3)
    for path, _ in jax.tree_util.tree_leaves_with_path(params):
        assert all(isinstance(part, jax.tree_util.DictKey) and isinstance(part.key, str) for part in path)
