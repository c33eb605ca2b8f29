"""Key-point fitting to what a network's own first stage sees: its key points, and the hand that fits them.

What a second stage must beat: the same heat maps, the solver of `poem fit`, and nothing learned after them.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.augmentation_recipes import Recipe
from poem_jax.evaluation.systems import Answer, Network, Seen
from poem_jax.fitting import FitConfig, KeypointNoise, Observations, fit_take, keypoint_model
from poem_jax.fitting.lm import LMConfig, ShapeMode
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.models.apply import apply
from poem_jax.models.config import Config, ModelConfig
from poem_jax.models.heat_maps import heat_variance
from poem_jax.typing import Array, Params

_LEAST_VARIANCE = 0.25
"""Cells squared: a map of one cell still says no more than which."""


class FirstStageFitting:
    """A network's heat maps and the solver of `poem fit`; see `System`."""

    takes_root = False
    one_at_a_time = False
    least_views = 2
    most_views: int | None = None

    def __init__(self, config: ModelConfig, params: Params) -> None:
        """Take a network.

        Raises:
            ValueError: it has no heat maps of all joints.
        """
        joints = config.root.num_joints if isinstance(config, Config) else 0
        if joints != NUM_JOINTS:
            raise ValueError(f"`config` must be a POEM v2 with {NUM_JOINTS} heat maps; got {joints}")
        network = Network(config, params)
        self.hand, self.image_hw = network.hand, network.image_hw
        self.recipe: Recipe = network.recipe
        self._config, self._params = config, params
        self._model = keypoint_model(self.hand)

    def __call__(self, batch: MultiViewBatch, seen: Sequence[Seen]) -> Answer:
        """Fit one hand per sample; one that two views do not show is not valid."""
        uv, weights = _key_points(self._params, batch.views, batch.cameras, config=self._config)
        K, T_cam_from_world, _ = batch.cameras
        noise = KeypointNoise.of_images(np.array([self.image_hw[::-1]]))
        config = FitConfig(LMConfig(shape_mode=ShapeMode.PER_FRAME), noise)
        observed = Observations(uv, weights, jnp.asarray(K), jnp.asarray(T_cam_from_world))
        found = fit_take(self._model, observed, config=config)
        return Answer(*map(np.asarray, (found.joints, found.vertices, found.valid)))


@partial(jax.jit, static_argnames="config")
def _key_points(params: Params, views: Array, cams: Cameras, *, config: ModelConfig) -> tuple[Array, Array]:
    """Return key points, NaN in masked views, and their weights: one over the heat map's variance."""
    found = apply(params, views, cams, config=config)
    assert found.keypoints_px is not None
    assert found.heat_maps is not None
    uv = jnp.where(jnp.asarray(cams.view_mask)[..., None, None], found.keypoints_px, jnp.nan)
    return uv, 1 / jnp.maximum(heat_variance(found.heat_maps), _LEAST_VARIANCE)
