"""The public face of the models: `preset`, `init`, `apply`, and `forward` for training.

A model works in the primary camera's frame; here the user's world comes in and goes out, and nowhere else.
"""

import functools

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, fill_masked_views
from poem_jax.models import parameters
from poem_jax.models.batch_norm import NormMode
from poem_jax.models.checks import check_inputs
from poem_jax.models.config import Config
from poem_jax.models.far_world import Origin, centre_world, move_back
from poem_jax.models.presets import V2_BASE, preset
from poem_jax.models.primary_frame import enter_primary_frame, leave_primary_frame
from poem_jax.typing import Array, Bool, Float, Num, Params, PRNGKeyArray

__all__ = ["apply", "forward", "init", "preset"]


def init(config: Config, *, key: PRNGKeyArray) -> Params:
    """Return fresh parameters: `trainable`, `statistics`, and `constants` (basis, template, hand)."""
    return _init(config, key)


@functools.partial(jax.jit, static_argnums=0)
def _init(config: Config, key: PRNGKeyArray) -> Params:
    return parameters.split(parameters.build(config, nnx.Rngs(params=key)))


def apply(
    params: Params,
    views: Num[Array, "batch view h w 3"],
    cams: Cameras,
    *,
    config: Config | None = None,
    root_world: Float[Array, "batch 3"] | None = None,
) -> Prediction:
    """Reconstruct one hand per sample from its valid views.

    Pure: `jax.jit`, `vmap`, `grad` (also with respect to `cams` and `root_world`) and `pmap` work on it. The
    padded numbers of samples and views choose the program; `cams.view_mask` does not. It is bool and has no
    derivative, so gradients of whole cameras need `allow_int`:

        jax.grad(lambda cams: apply(params, views, cams).vertices_world.sum(), allow_int=True)(cams)

    whose fields `K` and `T_cam_from_world` hold the gradient; or differentiate by these two arrays alone.

    The world may have its origin far from the hand (up to 1.6 km), and then `T_cam_from_world` should be
    float64: concrete extrinsics are moved to the primary camera before anything is rounded. Under a trace
    (`jit`, `grad`) they cannot be, so there the origin should be within some metres of the hand.

    Args:
        params: from `init` or `load`.
        views: RGB, uint8 or float in [0, 1]; masked views may hold anything.
        cams: intrinsics of these images, extrinsics from any world frame, `view_mask`.
        config: the configuration that `params` were made with; None = `v2-base`.
        root_world: joint 9 in metres where it is known; needed by samples with one view. A row of NaN is
            unknown: that sample's root is triangulated, as all are for None.

    Returns: the prediction in the world frame of `cams`. Under a trace, a sample that cannot be solved has
    `valid` False and finite numbers.

    Raises:
        ValueError: `params` of another config, or inputs that are concrete and wrong.
    """
    config = V2_BASE if config is None else config
    parameters.check_params(config, params)
    check_inputs(views, cams, root_world, config)
    centred = centre_world(cams, root_world, params["constants"]["basis_points"].dtype)
    return _predict(params, views, *centred, config=config)


@functools.partial(jax.jit, static_argnames="config")
def _predict(
    params: Params,
    views: Array,
    cams: Cameras,
    root_world: Array | None,
    origin: Origin,
    *,
    config: Config,
) -> Prediction:
    prediction, _ = forward(params, views, cams, config=config, root_world=root_world)
    return move_back(prediction, origin)


def forward(
    params: Params,
    views: Num[Array, "batch view h w 3"],
    cams: Cameras,
    *,
    config: Config,
    root_world: Float[Array, "batch 3"] | None = None,
    train: bool = False,
    key: PRNGKeyArray | None = None,
    axis_name: str | None = None,
) -> tuple[Prediction, dict]:
    """Do what `apply` does without its checks, and return the batch-norm statistics too.

    Args:
        params: from `init` or `load`.
        views: as in `apply`.
        cams: as in `apply`.
        config: the configuration that `params` were made with.
        root_world: as in `apply`, in training the noisy true root; NaN rows are triangulated.
        train: normalise by the moments of this batch's valid views and move the running statistics.
        key: in training, what dropout draws from; None = nothing is dropped.
        axis_name: device axis over which the moments are averaged.

    Returns: the prediction, and the new `params["statistics"]` (unchanged unless `train`).
    """
    dtype = params["constants"]["basis_points"].dtype
    images, cams, whole = _sound_inputs(normalised_images(views, config, dtype), _cast(cams, dtype))
    frame = enter_primary_frame(cams, root_world)
    model = parameters.assemble(config, params)
    mode = NormMode(cams.view_mask.reshape(-1) if train else None, axis_name)
    result = model(images, frame.cams, frame.root, mode, key if train else None)
    result = result._replace(valid=result.valid & whole)
    hand, order = model.hand.model(), config.decoder.query_order
    prediction = leave_primary_frame(result, frame.T_world_from_primary, hand, order)
    return prediction, parameters.statistics(model) if train else params["statistics"]


def normalised_images(
    views: Num[Array, "*batch h w 3"], config: Config, dtype: jnp.dtype
) -> Float[Array, "*batch h w 3"]:
    """Return images as a model takes them: (value in [0, 1] - mean) / std."""
    scale = 255.0 if views.dtype == jnp.uint8 else 1.0
    return (jnp.asarray(views, dtype) / scale - config.image_mean) / config.image_std


def _cast(cams: Cameras, dtype: jnp.dtype) -> Cameras:
    K, T_cam_from_world, view_mask = cams
    return Cameras(jnp.asarray(K, dtype), jnp.asarray(T_cam_from_world, dtype), jnp.asarray(view_mask))


def _sound_inputs(
    images: Array, cams: Cameras
) -> tuple[Float[Array, "batch view h w 3"], Cameras, Bool[Array, " batch"]]:
    """Mask views that hold NaN or infinity, empty the masked ones, and tell which samples were whole."""
    finite = _finite_per_view(images) & _finite_per_view(cams.K) & _finite_per_view(cams.T_cam_from_world)
    sound = fill_masked_views(cams._replace(view_mask=cams.view_mask & finite))
    images = jnp.where(sound.view_mask[..., None, None, None], images, 0)
    return images, sound, jnp.all(finite | ~cams.view_mask, -1)


def _finite_per_view(values: Float[Array, "batch view *rest"]) -> Bool[Array, "batch view"]:
    return jnp.all(jnp.isfinite(values), tuple(range(2, values.ndim)))
