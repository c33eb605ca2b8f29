"""The public face of the models: `init` and `apply`, with the checks of their arguments.

Static facts are checked always; values only where they are concrete, not traced.
"""

import functools
from typing import Any

import jax
import numpy as np
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.camera_checks import check_cameras
from poem_jax.geometry.cameras import Cameras, fill_masked_views, normalised_from_pixels, project
from poem_jax.geometry.transforms import invert_rigid, rotate_points
from poem_jax.geometry.triangulation import MIN_BASELINE, triangulate
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT
from poem_jax.models import network
from poem_jax.models.config import GridDraw, ModelConfig
from poem_jax.models.layers import NormMode
from poem_jax.models.presets import V2_BASE
from poem_jax.models.world_frame import WorkingFrame, enter_working_frame, is_traced
from poem_jax.typing import Array, Bool, Float, Int, Num, Params, PRNGKeyArray

_PARALLEL = 1e-2
"""Radians. Rays that differ by less are called parallel in messages."""


def init(config: ModelConfig, *, key: PRNGKeyArray) -> Params:
    """Return fresh parameters: `trainable`, `statistics`, and `constants` (hand, template, basis, ...).

    The weights are drawn by NumPy with a seed from `key`, since that compiles nothing. Under `jit` or `vmap`
    JAX draws them: other numbers of the same distribution, and a minute of compiling for a large model.
    """
    return jax.tree.map(jax.numpy.asarray, network.split(network.build(config, nnx.Rngs(params=key))))


def apply(
    params: Params,
    views: Num[Array, "batch view h w 3"],
    cams: Cameras,
    *,
    config: ModelConfig | None = None,
    root_world: Float[Array, "batch 3"] | None = None,
    ball_index: Int[Array, "batch point"] | None = None,
    key: PRNGKeyArray | None = None,
) -> Prediction:
    """Reconstruct one hand per sample from its valid views.

    Pure: `jax.jit`, `vmap`, `grad` (with respect to `params`, `cams` and `root_world`) and `pmap` work on
    it. The padded numbers of samples and views choose the program; `cams.view_mask` does not. It is bool and
    has no derivative, so gradients of whole cameras need `allow_int`:

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
            unknown: that sample's root is triangulated, as all are for None. Only for systems whose config
            `takes_root`.
        ball_index: for systems that draw basis points from the grids before the cameras
            (`config.grid_draw`): which points each sample reads, as numbers in its grid (view, w, h, depth),
            flattened; -1 where the ball held no more. None = drawn with `key`.
        key: for the same systems, one JAX key; None = key 0. Unused where `ball_index` is given.

    Returns: the prediction in the world frame of `cams`; what the system does not have is None there. Under a
    trace, a sample that cannot be solved has `valid` False and finite numbers.

    Raises:
        ValueError: `params` of another config, inputs that are concrete and wrong or that the system does not
            take, a number of views that it cannot take, or concrete samples whose cameras and images do not
            determine where the hand is.
    """
    config = V2_BASE if config is None else config
    network.check_params(config, params)
    check_inputs(views, cams, root_world, config, ball_index, key)
    frame = enter_working_frame(views, cams, root_world, network.number_type(params))
    draw = network.Draw.of(config, ball_index, key)
    prediction = _predict(params, views, frame, draw, config=config)
    check_solved(prediction, frame, config)
    return prediction


@functools.partial(jax.jit, static_argnames="config")
def _predict(
    params: Params, views: Array, frame: WorkingFrame, draw: network.Draw, *, config: ModelConfig
) -> Prediction:
    return network.reconstruct(network.assemble(config, params), views, frame, NormMode(), draw)


def check_inputs(
    views: Any, cams: Any, root_world: Any, config: ModelConfig, ball_index: Any = None, key: Any = None
) -> None:
    """Raise `ValueError` that says what, expected, got and fix; the arguments are those of `apply`."""
    _check_taken(config, root_world=root_world, ball_index=ball_index, key=key)
    _check_types(views, cams, root_world)
    _check_views(views, config)
    network.check_view_count(config, views.shape[1])
    if ball_index is not None and config.grid_draw is not None:
        _check_ball_index(ball_index, len(views), config.grid_draw)
    if np.shape(cams.K) != (*views.shape[:2], 3, 3):
        raise ValueError(
            f"`cams.K` must have shape (batch, view, 3, 3) = {(*views.shape[:2], 3, 3)}, as `views` says; "
            f"got {np.shape(cams.K)}"
        )
    traced = is_traced(views, cams, root_world)
    if root_world is not None and not traced:
        _check_root(np.asarray(root_world))
    check_cameras(cams, config.image_hw, root_world)
    if ball_index is not None and config.grid_draw is not None and not is_traced(ball_index, cams.view_mask):
        _check_grid_points(np.asarray(ball_index), np.asarray(cams.view_mask), config.grid_draw)
    if not traced:
        _check_view_counts(cams, root_world, config)
        _check_float_images(views, np.asarray(cams.view_mask))


def _check_taken(config: ModelConfig, *, root_world: Any, ball_index: Any, key: Any) -> None:
    """Refuse arguments that a system has no use for."""
    system = type(config).__name__
    if root_world is not None and not config.takes_root:
        raise ValueError(
            f"`root_world` must be None for this {system}, which has no use for a known root; leave it out"
        )
    for name, value in (("ball_index", ball_index), ("key", key)):
        if value is not None and config.grid_draw is None:
            raise ValueError(
                f"`{name}` must be None for this {system}, which draws no points from the cameras' grids; "
                "leave it out"
            )
    if key is not None and not _is_one_key(key):
        raise ValueError(f"`key` must be one key of `jax.random`; got {key!r}")


def _is_one_key(key: Any) -> bool:
    """Whether this is a key of `jax.random.key`, or one of the older `jax.random.PRNGKey`."""
    if not isinstance(key, jax.Array):
        return False
    typed = jax.numpy.issubdtype(key.dtype, jax.dtypes.prng_key)
    return key.shape == () if typed else key.dtype == np.uint32 and key.ndim == 1


def _check_ball_index(ball_index: Any, batch: int, draw: GridDraw) -> None:
    shape, wanted = np.shape(ball_index), (batch, draw.num_points)
    if not isinstance(ball_index, np.ndarray | jax.Array) or not np.issubdtype(ball_index.dtype, np.integer):
        kind = getattr(ball_index, "dtype", type(ball_index).__name__)
        raise ValueError(f"`ball_index` must be an array of whole numbers; got {kind}. Convert it to int32")
    if shape != wanted:
        raise ValueError(f"`ball_index` must have shape (batch, point) = {wanted}; got {shape}")


def _check_grid_points(
    ball_index: Int[np.ndarray, "batch point"], view_mask: Bool[np.ndarray, "batch view"], draw: GridDraw
) -> None:
    """Raise unless every sample has basis points, all of them of valid views."""
    num_views, (low, high) = view_mask.shape[1], (int(ball_index.min()), int(ball_index.max()))
    size = num_views * draw.points_per_view
    if low < -1 or high >= size:
        raise ValueError(
            f"`ball_index` must number the {size} grid points of {num_views} views, 0 to {size - 1}, with -1 "
            f"where the ball held no more; got {low} to {high}. Number them in the order (view, w, h, "
            "depth), with padded views counted"
        )
    held = ball_index >= 0
    empty = np.asarray(~held.any(-1))
    if empty.any():
        raise ValueError(
            f"`ball_index` must name at least one grid point; in samples {_where(empty)} all are -1"
        )
    view = np.maximum(ball_index, 0) // draw.points_per_view
    lost = held & ~np.take_along_axis(view_mask, view, 1)
    if lost.any():
        samples = np.asarray(lost.any(-1))
        raise ValueError(
            "`ball_index` must name points of valid views, since masked ones have no grids; samples "
            f"{_where(samples)} name points of the masked views {sorted(set(view[lost].tolist()))}. "
            "Number the points with masked views counted, or draw them with `key`"
        )


def _check_types(views: Any, cams: Any, root_world: Any) -> None:
    if not isinstance(cams, Cameras):
        raise ValueError(
            f"`cams` must be `Cameras(K, T_cam_from_world, view_mask)`; got {type(cams).__name__}. "
            "Build it with `poem_jax.Cameras`"
        )
    arrays = {"views": views, **{f"cams.{name}": leaf for name, leaf in cams._asdict().items()}}
    if root_world is not None:
        arrays["root_world"] = root_world
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray | jax.Array):
            raise ValueError(
                f"`{name}` must be a NumPy or JAX array; got {type(array).__name__}. "
                f"Convert it with `numpy.asarray` (images: `numpy.stack`)"
            )


def _check_views(views: Array, config: ModelConfig) -> None:
    shape = np.shape(views)
    if len(shape) != 5 or shape[2:] != (*config.image_hw, 3):
        raise ValueError(
            f"`views` must have shape (batch, view, *{config.image_hw}, 3); got {shape}. "
            "Crop and resize the images, and adapt K, with `crop_intrinsics`."
        )
    if 0 in shape:
        raise ValueError(f"`views` must hold at least one sample of one view; got shape {shape}")
    if views.dtype != np.uint8 and "float" not in str(views.dtype):
        raise ValueError(f"`views` must be uint8, or float in [0, 1]; got {views.dtype}")


def _check_view_counts(cams: Cameras, root_world: Array | None, config: ModelConfig) -> None:
    """A root that is not known needs two cameras at different places, if the system triangulates one."""
    mask = np.asarray(cams.view_mask)
    counts = mask.sum(-1)
    if (counts == 0).any():
        raise ValueError(
            f"every sample needs at least one valid view; `cams.view_mask` of samples {_where(counts == 0)} "
            "is all False. Drop these samples."
        )
    if not config.triangulates:
        return
    root_or = "`root_world` of shape (batch, 3), or " if config.takes_root else ""
    unknown = np.isnan(np.full((len(mask), 3), np.nan) if root_world is None else root_world).any(-1)
    lost = (counts == 1) & unknown
    if lost.any():
        needs = "`root_world`" if config.takes_root else "another"
        raise ValueError(
            f"a sample with one valid view needs {needs}, since one view does not fix the root; samples "
            f"{_where(lost)} have one, and no root. Give {root_or}another view."
        )
    centre = invert_rigid(fill_masked_views(Cameras(*map(np.asarray, cams))).T_cam_from_world)[..., :3, 3]
    apart = np.where(mask[..., None], centre - centre[np.arange(len(mask)), mask.argmax(-1)][:, None], 0)
    lost = (np.abs(apart).max((1, 2)) < MIN_BASELINE) & unknown
    if lost.any():
        raise ValueError(
            "cameras at one place do not fix how far the hand is; in samples "
            f"{_where(lost)} all valid views stand within {MIN_BASELINE} m. Give each view its own "
            f"`T_cam_from_world`{', or `root_world`' if config.takes_root else ''}"
        )


def _check_root(root_world: np.ndarray) -> None:
    """NaN stands for an unknown root, which two views can triangulate."""
    unknown = np.isnan(root_world).all(-1)
    broken = np.asarray(~unknown & ~np.isfinite(root_world).all(-1))
    if broken.any():
        raise ValueError(
            "`root_world` must be finite, or NaN in all three coordinates where the root is unknown; samples "
            f"{_where(broken)} hold NaN or infinity"
        )


def _check_float_images(views: Array, mask: np.ndarray) -> None:
    if views.dtype == np.uint8:
        return
    low, high = (np.asarray(extreme(views, axis=(2, 3, 4)), np.float32) for extreme in (np.min, np.max))
    broken = mask & ~np.isfinite(low + high)
    if broken.any():
        raise ValueError(f"`views` must be finite; views {_where(broken)} hold NaN or infinity")
    low, high = low[mask].min(), high[mask].max()
    if low < 0 or high > 1:
        raise ValueError(
            f"float `views` must be in [0, 1]; got values from {low:g} to {high:g}. "
            "Divide by 255, or pass uint8."
        )


def _where(condition: np.ndarray) -> list:
    return (
        np.argwhere(condition).squeeze(-1).tolist()
        if condition.ndim == 1
        else np.argwhere(condition).tolist()
    )


def check_solved(prediction: Prediction, frame: WorkingFrame, config: ModelConfig) -> None:
    """Raise `ValueError` that names the samples that have no answer, and says why."""
    if is_traced(prediction.valid, frame) or np.asarray(prediction.valid).all():
        return
    lost = ~np.asarray(prediction.valid)
    if config.triangulates:
        # A root that was given is not sought with rays.
        _check_rays(prediction, frame, config, lost & ~np.isfinite(frame.known_root).all(-1))
    if config.needs_all_joints:
        _check_joints(prediction, lost)
    if config.grid_draw is not None:
        raise ValueError(
            f"points of the cameras' grids must lie in the ball about {config.grid_draw.about}; in samples "
            f"{_where(lost)} none does. Check that the cameras look there, at distances that their grids "
            "reach, and that `T_cam_from_world` is in metres"
        )
    raise ValueError(f"samples {_where(lost)} have no answer: their views determine none")


def _check_rays(
    prediction: Prediction, frame: WorkingFrame, config: ModelConfig, lost: Bool[np.ndarray, " batch"]
) -> None:
    """Raise unless the rays to the root meet before their cameras in all samples of `lost`."""
    if not lost.any():
        return
    assert prediction.keypoints_px is not None
    root_or = "`root_world`, or " if config.takes_root else ""
    joint = ROOT_JOINT if prediction.keypoints_px.shape[2] == NUM_JOINTS else 0
    uv_px = np.asarray(prediction.keypoints_px, np.float64)[:, :, joint]
    angle = _widest_angle(frame.cams, uv_px)
    if (angle[lost] < _PARALLEL).all():
        raise ValueError(
            f"the views must see the hand from different directions to fix its distance; in samples "
            f"{_where(lost)} all rays to the root are parallel, to {angle[lost].max():.2g} rad. Give "
            f"{root_or}a view from another side"
        )
    meets = lost & _rays_meet(frame.cams, uv_px)
    if config.grid_draw is not None and (meets == lost).all():
        return
    lost = lost & ~meets if (lost & ~meets).any() else lost
    raise ValueError(
        f"the views must look at one hand; in samples {_where(lost)} the rays to its root meet behind a "
        "camera, or nowhere. Check that images and cameras are in the same order and that "
        f"`T_cam_from_world` maps world to camera{', or give `root_world`' if config.takes_root else ''}"
    )


def _check_joints(prediction: Prediction, lost: Bool[np.ndarray, " batch"]) -> None:
    """Raise where other joints than the root could not be triangulated."""
    assert prediction.reference_joints_mask is not None
    missing = lost[:, None] & ~np.asarray(prediction.reference_joints_mask)
    if missing.any():
        samples = np.asarray(missing.any(-1))
        raise ValueError(
            f"this model needs all {NUM_JOINTS} joints triangulated; in samples {_where(samples)} "
            f"the rays to joints {np.flatnonzero(missing.any(0)).tolist()} meet behind a camera, or nowhere. "
            "Give views that see the whole hand"
        )


def _rays_meet(cams: Cameras, uv_px: Float[np.ndarray, "batch view 2"]) -> Bool[np.ndarray, " batch"]:
    """Whether the rays through one pixel of each view meet before every camera."""
    K, T_cam_from_primary, mask = (np.asarray(leaf) for leaf in cams)
    points, solved = triangulate(uv_px[:, :, None], K, T_cam_from_primary, mask=mask[..., None])
    _, depth = project(K, T_cam_from_primary, np.asarray(points)[:, None])
    return np.asarray(solved)[:, 0] & ((depth[..., 0] > 0) | ~mask).all(1)


def _widest_angle(cams: Cameras, uv_px: Float[np.ndarray, "batch view 2"]) -> Float[np.ndarray, " batch"]:
    """Return the widest angle between the rays through one pixel of each view, radians."""
    K, T_cam_from_primary, mask = (np.asarray(leaf) for leaf in cams)
    ones = np.ones_like(uv_px[..., :1])
    ray = np.concatenate([normalised_from_pixels(K, uv_px[:, :, None])[:, :, 0], ones], -1)
    ray = rotate_points(invert_rigid(T_cam_from_primary)[..., :3, :3], ray[:, :, None])[:, :, 0]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    sine = np.linalg.norm(np.cross(ray[:, :, None], ray[:, None]), axis=-1)
    return np.arcsin(np.clip(np.where(mask[:, :, None] & mask[:, None], sine, 0).max((1, 2)), 0, 1))
