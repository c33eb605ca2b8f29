"""A small model of every system: it comes back from disk as it was, sees three views among eight as it sees
them alone, and `infer` gives what `apply` gives."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.geometry.cameras import Cameras
from poem_jax.models.apply import apply, init
from poem_jax.models.config import ModelConfig
from poem_jax.models.infer import infer, prepare
from poem_jax.models.mesh_transformer_config import CanonicalFusion
from poem_jax.models.presets import preset
from poem_jax.weights.store import load, save
from tests.small_presets import small

PADDED, VALID = 8, [1, 4, 6]
"""Views, and which of them are valid."""
SLOW = ("v1", "pe-meshtr", "mvp", "mvp-release")
NAMES = ["ftl-meshtr", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
"""Each compiles three programs, so that one stands for all in the default suite."""


def config_of(name: str) -> ModelConfig:
    """Return the small model of a preset, made for as many views as the preset itself."""
    config = small(preset(name))
    if name.startswith("mvp"):
        return replace(config, num_views=PADDED)
    return replace(config, fusion=CanonicalFusion(3, PADDED)) if name == "ftl-meshtr" else config


@pytest.mark.parametrize("name", NAMES)
def test_saved_padded_and_inferred_it_is_the_same(name, make_scene, tmp_path):
    config = config_of(name)
    save(tmp_path / "model", config, init(config, key=jax.random.key(0)))
    config, params = load(tmp_path / "model", expected=config)
    images, cams = make_scene(1, PADDED)
    mask = np.isin(np.arange(PADDED), VALID)
    views = np.where(mask[:, None, None, None], images, 7)
    K = np.where(mask[:, None, None], cams.K, np.nan)
    given = {}
    if config.grid_draw is not None:
        per_view = config.grid_draw.points_per_view
        given["ball_index"] = np.arange(config.grid_draw.num_points)[None] % per_view + VALID[1] * per_view
    padded = apply(params, views, Cameras(K, cams.T_cam_from_world, mask[None]), config=config, **given)

    least, _ = config.view_range
    kept = VALID if least == 1 else range(PADDED)
    if given:
        given["ball_index"] = given["ball_index"] - (VALID[1] - 1) * per_view
    alone = Cameras(*(leaf[:, kept] for leaf in cams._replace(view_mask=mask[None])))
    inferred = infer(prepare(params, config), images[:, kept], alone, **given)
    np.testing.assert_allclose(inferred.layers_world, padded.layers_world, atol=5e-6)
    assert np.isfinite(padded.layers_world).all()
