"""Iterative fitting with Adam, as the paper states it and as its code released it.

The paper's recipe: 300 steps of Adam, step size 1e-2, halved when the loss has not improved for 50 steps. The
released recipe differs: the shape has a step size of its own (1e-3); the gradient is clipped to norm 0.1 over
all parameters; and it is never zeroed, so that every step adds the new gradient to the clipped previous one.
Both minimise 1000 * key points + 50 * anatomy over 16 quaternions, shape and translation, and, where masks
are given, 10 * silhouettes: the paper's cross-entropy, the release's L1. The weights are the release's; the
paper states none.

Written out instead of taken from optax: the accumulated gradient and the rule of the plateau, which must
follow PyTorch's `ReduceLROnPlateau` step by step, are the recipe.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from poem_jax.fitting.anatomy_loss import anatomy_loss, anatomy_terms, rotations_from_raw_quaternions
from poem_jax.fitting.kinematics import KeypointModel, joints_of, pose_keypoints_of_rotations
from poem_jax.fitting.observations import Observations
from poem_jax.fitting.silhouette import (
    Masks,
    SilhouetteTarget,
    silhouette_cross_entropy,
    silhouette_l1,
    silhouette_of_views,
)
from poem_jax.geometry.cameras import projection_jacobian
from poem_jax.hand.topology import WRIST
from poem_jax.render.soft import RELEASE_SIGMA
from poem_jax.typing import Array, Float, Int

KEYPOINT_WEIGHT = 1000.0
ANATOMY_WEIGHT = 50.0
SILHOUETTE_WEIGHT = 10.0
RELEASE_DIAGONAL_PX = 362.03867196751236
"""Diagonal of the release's 256 x 256 images."""

_BETAS = (0.9, 0.999)
_EPSILON = 1e-8


@dataclass(frozen=True)
class AdamRecipe:
    """How to descend; static under `jax.jit`."""

    steps: int = 300
    rate: float = 1e-2
    """Step size of pose and translation."""
    shape_rate: float = 1e-2
    patience: int = 50
    """Steps without improvement before the rates are halved."""
    threshold: float = 1e-4
    """Relative; less than this is no improvement."""
    min_rate: float = 1e-5
    clip_norm: float | None = None
    """Bound of the gradient's norm over all parameters together."""
    accumulate: bool = False
    """Add each new gradient to the clipped previous one."""
    silhouette_loss: Callable[[Array, Masks, Array], Array] = silhouette_cross_entropy
    """Used where masks are given."""
    silhouette_sigma: float = RELEASE_SIGMA
    """Softness of the drawn outline, NDC squared; the paper states none."""


ADAM_300 = AdamRecipe()
"""The paper's."""
ADAM_300_RELEASE = AdamRecipe(shape_rate=1e-3, clip_norm=0.1, accumulate=True, silhouette_loss=silhouette_l1)
"""The released code's."""


class AdamParameters(NamedTuple):
    """What Adam moves, for one frame."""

    quaternions: Float[Array, "16 4"]
    """wxyz, MANO order, of any length."""
    shape: Float[Array, "10"]
    translation: Float[Array, "3"]
    """Place of the wrist, metres, world frame."""


class AdamTrace(NamedTuple):
    """What happened at every step: values before it."""

    keypoint_loss: Float[Array, "step"]
    """Key-point term, without its weight."""
    loss: Float[Array, "step"]
    rates: Float[Array, "step 3"]
    """Step sizes of quaternions, shape and translation."""
    parameters: AdamParameters
    """After the step, with a leading axis of steps."""


class Plateau(NamedTuple):
    """The step sizes, and how long the loss has not improved."""

    rates: Float[Array, "3"]
    best: Float[Array, ""]
    waited: Int[Array, ""]
    """Steps since the best loss."""


class _State(NamedTuple):
    parameters: AdamParameters
    mean: AdamParameters
    square: AdamParameters
    gradient: AdamParameters
    plateau: Plateau
    count: Int[Array, ""]
    """Steps taken."""


def released_start(
    noise: Float[Array, "16 4"] | None = None, translation: Float[Array, "3"] | None = None
) -> AdamParameters:
    """Return the release's start: identity quaternions plus 0.1 * `noise`, mean shape, 0.6 m ahead.

    Args:
        noise: uniform in [0, 1) in the release; None adds none.
        translation: place of the wrist, metres; None puts it at (0, 0, 0.6) of the world.
    """
    identity = jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (16, 1))
    place = jnp.asarray([0, 0, 0.6]) if translation is None else translation
    return AdamParameters(identity if noise is None else identity + 0.1 * noise, jnp.zeros(10), place)


def fitting_loss(
    parameters: AdamParameters,
    model: KeypointModel,
    seen: Observations,
    diagonal_px: float | Array = RELEASE_DIAGONAL_PX,
    silhouettes: SilhouetteTarget | None = None,
    recipe: AdamRecipe = ADAM_300,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return 1000 * key points + 50 * anatomy (+ 10 * silhouettes) of a frame, and the key-point term alone.

    Key points: mean over views and joints of confidence * |projected - observed|^2 / diagonal^2; pixels with
    weight zero must be finite. Of `recipe` only what it says of silhouettes is used.
    """
    rotations = rotations_from_raw_quaternions(parameters.quaternions)
    posed = pose_keypoints_of_rotations(model, rotations, parameters.shape)
    pixels, _ = projection_jacobian(seen.K, seen.T_cam_from_world, posed.points + parameters.translation)
    square = jnp.sum((pixels - seen.uv_px) ** 2, axis=-1)
    keypoints = jnp.mean(seen.weights * square) / diagonal_px**2
    anatomy = anatomy_loss(
        anatomy_terms(
            parameters.quaternions,
            parameters.shape,
            posed.rotations,
            joints_of(model, posed),
            model.hand.is_left,
        )
    )
    loss = KEYPOINT_WEIGHT * keypoints + ANATOMY_WEIGHT * anatomy
    if silhouettes is not None:
        mesh = model.hand.shape(parameters.shape).pose_rotations(rotations).skin()
        vertices = mesh.vertices - mesh.joints[WRIST] + parameters.translation
        outline = silhouette_of_views(
            vertices, model.hand.faces, silhouettes, recipe.silhouette_loss, sigma=recipe.silhouette_sigma
        )
        loss = loss + SILHOUETTE_WEIGHT * outline
    return loss, keypoints


def adam_fit(
    model: KeypointModel,
    seen: Observations,
    start: AdamParameters,
    recipe: AdamRecipe = ADAM_300,
    *,
    diagonal_px: float | Array = RELEASE_DIAGONAL_PX,
    silhouettes: SilhouetteTarget | None = None,
    trace: bool = False,
) -> tuple[AdamParameters, AdamTrace | None]:
    """Fit one frame; map it over frames with `jax.vmap`.

    Args:
        seen: key points (view, 21, 2) and confidences; weight zero means "ignore", the pixels must be finite.
        start: where to begin, see `released_start`.
        recipe: static.
        diagonal_px: the unit of the key-point term, the images' diagonal.
        silhouettes: masks (view, h, w) and their cameras; None leaves the term out.
        trace: return what happened at every step as well.
    """

    def loss(parameters: AdamParameters) -> tuple[Array, Array]:
        return fitting_loss(parameters, model, seen, diagonal_px, silhouettes, recipe)

    def step(state: _State, _: None) -> tuple[_State, AdamTrace | None]:
        (value, keypoints), gradient = jax.value_and_grad(loss, has_aux=True)(state.parameters)
        after = _adam_step(state, gradient, value, recipe)
        return after, AdamTrace(keypoints, value, state.plateau.rates, after.parameters) if trace else None

    state, history = jax.lax.scan(step, _first_state(start, recipe), None, length=recipe.steps)
    return state.parameters, history


def _first_state(start: AdamParameters, recipe: AdamRecipe) -> _State:
    zero, none = jax.tree.map(jnp.zeros_like, start), jnp.zeros((), jnp.int32)
    dtype = start.translation.dtype
    rates = jnp.asarray([recipe.rate, recipe.shape_rate, recipe.rate], dtype)
    return _State(start, zero, zero, zero, Plateau(rates, jnp.asarray(jnp.inf, dtype), none), none)


def _adam_step(state: _State, gradient: AdamParameters, value: Array, recipe: AdamRecipe) -> _State:
    if recipe.accumulate:
        gradient = jax.tree.map(jnp.add, state.gradient, gradient)
    if recipe.clip_norm is not None:
        gradient = _clipped(gradient, recipe.clip_norm)
    first, second = _BETAS
    mean = jax.tree.map(lambda m, g: first * m + (1 - first) * g, state.mean, gradient)
    square = jax.tree.map(lambda s, g: second * s + (1 - second) * g * g, state.square, gradient)
    count = state.count + 1
    steps = count.astype(value.dtype)
    mean_bias, square_bias = 1 - first**steps, 1 - second**steps

    def moved(p: Array, m: Array, s: Array, rate: Array) -> Array:
        return p - rate / mean_bias * m / (jnp.sqrt(s) / jnp.sqrt(square_bias) + _EPSILON)

    rates = AdamParameters(*state.plateau.rates)
    parameters = jax.tree.map(moved, state.parameters, mean, square, rates)
    return _State(parameters, mean, square, gradient, wait_or_halve(state.plateau, value, recipe), count)


def _clipped(gradient: AdamParameters, bound: float) -> AdamParameters:
    """Scale the gradient to a norm of at most `bound`, as `torch.nn.utils.clip_grad_norm_`."""
    norm = jnp.sqrt(sum(jnp.sum(g * g) for g in gradient))
    factor = jnp.minimum(bound / (norm + 1e-6), 1)
    return jax.tree.map(lambda g: g * factor, gradient)


def wait_or_halve(plateau: Plateau, loss: Float[Array, ""], recipe: AdamRecipe) -> Plateau:
    """Halve the rates after more than `patience` steps without a better loss; return what holds next."""
    better = loss < plateau.best * (1 - recipe.threshold)
    waited = jnp.where(better, 0, plateau.waited + 1)
    halve = waited > recipe.patience
    rates = jnp.where(halve, jnp.maximum(0.5 * plateau.rates, recipe.min_rate), plateau.rates)
    return Plateau(rates, jnp.where(better, loss, plateau.best), jnp.where(halve, 0, waited))
