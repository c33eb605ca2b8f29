"""Key-point fitting to what a network's own first stage sees: its key points, and the hand that fits them.

What a second stage must beat: the same heat maps, the solver of `poem fit`, and nothing learned after them.
Where too few key points agree for the solver, the hand is the template posed by all of them, triangulated.
"""

from collections.abc import Sequence
from dataclasses import astuple
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.augmentation_recipes import Recipe
from poem_jax.evaluation.systems import Answer, Network, Seen
from poem_jax.fitting import FitConfig, KeypointNoise, Observations, fit_take, keypoint_model
from poem_jax.fitting.kinematics import KeypointModel
from poem_jax.fitting.lm import LMConfig, ShapeMode
from poem_jax.fitting.take import FitResult
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.model import HandModel, template_queries
from poem_jax.hand.topology import NUM_JOINTS, split_queries
from poem_jax.models.apply import apply
from poem_jax.models.config import Config, ModelConfig
from poem_jax.models.hand_output import first_queries
from poem_jax.models.heat_maps import heat_variance
from poem_jax.typing import Array, Float, Params

_LEAST_VARIANCE = 0.25
"""Cells squared: a map of one cell still says no more than which."""
_NOISE = KeypointNoise(gate_px=8.0, expected_px=2.0, min_px=0.3)
_NOISE_OF_TWO = KeypointNoise(gate_px=16.0, expected_px=4.0, min_px=0.3)
"""Of key points of the shipped first stage in crops of 128 x 128, half of which are off by more than 5 px; of
samples with two views, where nothing but the gate tells an outlier. The solver's own figures are of a
detector in whole images, and reject most. Chosen by 256 captures of the synthetic table's training data:
docs/tables.md."""


class FirstStageFitting:
    """A network's heat maps and the solver of `poem fit`; see `System`.

    Its key points are expected to be as good as those of the shipped first stage.
    """

    takes_root = False
    one_at_a_time = False
    least_views = 2
    most_views: int | None = None

    def __init__(self, config: ModelConfig, params: Params) -> None:
        """Take a network.

        Raises:
            ValueError: it has no heat maps of all joints.
        """
        if not sees_joints(config):
            maps = config.root.num_joints if isinstance(config, Config) else 0
            raise ValueError(f"`config` must be a POEM v2 with {NUM_JOINTS} heat maps; got {maps}")
        network = Network(config, params)
        self.hand, self.image_hw = network.hand, network.image_hw
        self.recipe: Recipe = network.recipe
        self._config, self._params = config, params
        self._model = keypoint_model(self.hand)
        scale = float(np.hypot(*self.image_hw) / np.hypot(128, 128))
        self._fits = tuple(
            FitConfig(LMConfig(shape_mode=ShapeMode.PER_FRAME), _scaled(noise, scale))
            for noise in (_NOISE_OF_TWO, _NOISE)
        )

    @property
    def settings(self) -> str:
        """Tell this fit from one with other settings, in words."""
        return f"{self._fits}, else the posed template"

    def __call__(self, batch: MultiViewBatch, seen: Sequence[Seen]) -> Answer:
        """Fit one hand per sample; not valid where it is the posed template, for too few key points agree."""
        points = _look(self._params, batch.views, batch.cameras, config=self._config)
        K, T_cam_from_world, view_mask = batch.cameras
        observed = Observations(points.uv_px, points.weights, jnp.asarray(K), jnp.asarray(T_cam_from_world))
        has_two = np.sum(view_mask, axis=-1) <= 2
        joints, vertices, valid = np.array(points.joints), np.array(points.vertices), np.zeros(len(K), bool)
        for samples, config in zip((has_two, ~has_two), self._fits, strict=True):
            if samples.any():
                found = _fit_each(self._model, observed, config=config)
                taken = samples & np.asarray(found.valid)
                joints[taken], vertices[taken] = (
                    np.asarray(found.joints)[taken],
                    np.asarray(found.vertices)[taken],
                )
                valid |= taken
        return Answer(joints, vertices, valid)


def sees_joints(config: ModelConfig) -> bool:
    """Tell whether a model is a POEM v2 with heat maps of all joints."""
    return isinstance(config, Config) and config.root.num_joints == NUM_JOINTS


def _scaled(noise: KeypointNoise, scale: float) -> KeypointNoise:
    return KeypointNoise(*(scale * value for value in astuple(noise)))


class _KeyPoints(NamedTuple):
    """What a first stage sees, and the template posed by it, world frame; the resting template where a joint
    could not be triangulated."""

    uv_px: Float[Array, "batch view 21 2"]
    """NaN in masked views."""
    weights: Float[Array, "batch view 21"]
    """One over the heat map's variance."""
    joints: Float[Array, "batch 21 3"]
    vertices: Float[Array, "batch 778 3"]


@partial(jax.jit, static_argnames="config")
def _fit_each(model: KeypointModel, observed: Observations, *, config: FitConfig) -> FitResult:
    """Fit every sample by itself; the frames of a take would tell each other how noisy they are."""

    def fit(*sample: Array) -> FitResult:
        return fit_take(model, Observations(*(leaf[None] for leaf in sample)), config=config)

    return jax.tree.map(lambda leaf: leaf[:, 0], jax.vmap(fit)(*observed))


@partial(jax.jit, static_argnames="config")
def _look(params: Params, views: Array, cams: Cameras, *, config: Config) -> _KeyPoints:
    found = apply(params, views, cams, config=config)
    assert found.keypoints_px is not None
    assert found.heat_maps is not None
    assert found.root_world is not None
    assert found.reference_joints_world is not None
    assert found.reference_joints_mask is not None
    uv = jnp.where(jnp.asarray(cams.view_mask)[..., None, None], found.keypoints_px, jnp.nan)
    root, order = found.root_world[:, None], config.decoder.query_order
    solved = jnp.all(found.reference_joints_mask, -1) & found.valid
    hand = HandModel(**params["constants"]["hand"])
    posed = first_queries(
        hand,
        template_queries(hand, order),
        found.reference_joints_world - root,
        solved,
        config.basis.radius,
        order,
    )
    vertices, joints = split_queries(posed + root, order)
    weights = 1 / jnp.maximum(heat_variance(found.heat_maps), _LEAST_VARIANCE)
    return _KeyPoints(uv, weights, joints, vertices)
