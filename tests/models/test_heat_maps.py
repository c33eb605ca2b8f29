"""The spread of heat maps as the weight of a view: off for paper and release, on where asked for."""

import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.models.config import Config, ViewWeights
from poem_jax.models.heat_maps import heat_variance
from poem_jax.models.presets import PRESETS


def gaussian(centre, sigma, size=(48, 40)):
    v, u = np.mgrid[: size[0], : size[1]]
    heat = np.exp(-((u - centre[0]) ** 2 / sigma[0] ** 2 + (v - centre[1]) ** 2 / sigma[1] ** 2) / 2)
    return heat / heat.sum()


@pytest.mark.parametrize("sigma", [(1.0, 1.0), (3.0, 2.0), (2.0, 4.0)])
def test_the_spread_of_a_normal_map_is_its_variance(sigma):
    maps = np.stack([gaussian(centre, sigma) for centre in ((20.0, 24.0), (17.5, 22.25))])
    np.testing.assert_allclose(
        heat_variance(jnp.asarray(maps, jnp.float32)), sum(s**2 for s in sigma), rtol=1e-3
    )


def test_a_single_cell_has_no_spread_and_two_cells_have_their_distances():
    maps = np.zeros((2, 8, 8), np.float32)
    maps[0, 3, 5] = 1
    maps[1, 2, 1] = maps[1, 2, 5] = 0.5
    np.testing.assert_allclose(heat_variance(jnp.asarray(maps)), [0, 4], atol=1e-5)


def test_paper_and_release_weigh_all_views_alike():
    of_v2 = {name: preset for name, preset in PRESETS.items() if isinstance(preset, Config)}
    alike = {name for name, preset in of_v2.items() if preset.root.view_weights is ViewWeights.EQUAL}
    assert set(of_v2) - alike == {"tiny"}
