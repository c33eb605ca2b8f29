"""Fit a hand to the 2D key points of calibrated views: one call per take and hand.

`fit_take` triangulates robustly, poses the hand in closed form, and refines pose, place and shape by
Levenberg-Marquardt (`lm`). `fit_take_adam` runs the paper's iterative optimisation on the same input. Both
compile themselves, once per configuration and size, and work within `jax.jit` (config static) and `jax.vmap`
(over hands or takes; models of several hands are stacked leaf by leaf). No bad frame stops a take.

Worlds may be far from their origin: concrete extrinsics in float64 are moved near it before they are rounded,
and results come back in float64. Under a trace this is not possible, and not done.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from poem_jax.fitting.adam import ADAM_300, AdamParameters, AdamRecipe, adam_fit, released_start
from poem_jax.fitting.anatomy_loss import rotations_from_raw_quaternions
from poem_jax.fitting.kinematics import KeypointModel, joints_of, pose_keypoints, rest_wrist
from poem_jax.fitting.lm import (
    LMConfig,
    ShapeMode,
    TakeObservations,
    TakeState,
    frame_cost,
    joint_sigma,
    solve,
)
from poem_jax.fitting.observations import Observations, clean
from poem_jax.fitting.robust_triangulation import (
    REFERENCE_DIAGONAL_PX,
    KeypointNoise,
    RobustPoints,
    triangulate_robust,
)
from poem_jax.fitting.silhouette import SilhouetteTarget
from poem_jax.fitting.smooth import SmoothConfig, smooth, smoothed_sigma
from poem_jax.fitting.start import can_be_placed, closed_form_pose
from poem_jax.geometry.cameras import projection_jacobian
from poem_jax.geometry.transforms import axis_angle_from_rotation
from poem_jax.geometry.world_origin import distant_origin, move_origin
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES, WRIST
from poem_jax.typing import Array, Bool, Float

_PLACES = ("translation", "joints", "vertices", "keypoints", "alone")


@dataclass(frozen=True)
class FitConfig:
    """Static settings of `fit_take`."""

    lm: LMConfig = field(default_factory=LMConfig)
    noise: KeypointNoise = field(default_factory=KeypointNoise)
    """What to expect of the key points: `KeypointNoise.of_images(size_wh)` for images of another size."""
    smooth: SmoothConfig | None = None
    """A second pass over the whole take; None leaves it out. Not with a shape of its own in every frame."""

    def __post_init__(self) -> None:
        if self.smooth is not None and self.lm.shape_mode is ShapeMode.PER_FRAME:
            raise ValueError("`smooth` holds the frames of one hand together; got ShapeMode.PER_FRAME")


class FitResult(NamedTuple):
    """A hand over a take. World frame, metres; where not `valid`, finite numbers that mean nothing.

    Of a far world, `translation`, `joints`, `vertices`, `keypoints` and `alone` are NumPy arrays in float64.
    """

    pose: Float[Array, "frame 16 3"]
    """Axis-angle, MANO order; row 0 turns the hand about its wrist joint into the world."""
    shape: Float[Array, "frame 10"]
    """The same in every frame unless fitted per frame."""
    translation: Float[Array, "frame 3"]
    """As `hand_mesh` takes it."""
    joints: Float[Array, "frame 21 3"]
    """The hand model's own joints and tips, whatever the offsets of the detector."""
    vertices: Float[Array, "frame 778 3"]
    valid: Bool[Array, "frame"]
    """True where at least two views gave three or more joints that do not lie on one line."""
    reprojection_px: Float[Array, "frame view"]
    """Mean distance of the fitted `keypoints` from those seen, outliers included; NaN where a view has
    none."""
    sigma_m: Float[Array, "frame 21"]
    """Standard deviation of one coordinate of each joint; zero where not `valid`."""
    inlier_mask: Bool[Array, "frame view 21"]
    """The key points that agree with each other, and were fitted."""
    sigma_px: Float[Array, "frame"]
    """Estimated noise of one coordinate of a key point, pixels."""
    cost: Float[Array, "frame"]
    """How unlikely the hand is in this frame: half the sum of squares, in standard deviations, of key points
    (robust), pose prior and joint limits; NaN where not `valid`. A hand of the wrong side costs more."""
    keypoints: Float[Array, "frame 21 3"]
    """Where the detector should see the joints: `joints` moved by the offsets of the model, if it has any."""
    alone: Float[Array, "frame 21 3"]
    """The joints as each frame by itself has them: those of the first pass, where there is a second."""


def fit_take(
    model: KeypointModel,
    observations: Observations,
    shape: Float[Array, "..."] | None = None,
    config: FitConfig = FitConfig(),
    time_s: Float[Array, "frame"] | None = None,
) -> FitResult:
    """Fit one hand to all frames of a take.

    Shapes are checked here, so that a wrong one is told in words.

    Args:
        model: `keypoint_model(hand)` of the hand's own side, with the calibration of the detector if the
            key points are those of a known one.
        observations: `uv_px` (frame, view, 21, 2); `weights` (frame, view, 21) or None; `K` and
            `T_cam_from_world` (view, ...) or (frame, view, ...).
        shape: the known shape (10,) or (frame, 10); needed by, and only used in, `ShapeMode.GIVEN`.
        config: static under `jax.jit`; its `noise` is that of 1280 x 720 images unless given:
            `FitConfig(noise=KeypointNoise.of_images(size_wh))`.
        time_s: when each frame was taken, seconds, later and later; for the second pass alone. None = frames
            `SmoothConfig.seconds` apart.

    Raises:
        ValueError: fewer than two views; key points, cameras, shape and times that do not belong together; a
            far world whose extrinsics are not float64.
    """
    _check(observations, shape, config.lm.shape_mode is ShapeMode.GIVEN)
    steps_s = _steps_s(time_s, len(observations.uv_px), config)
    near, origin = _near_world(model, observations)
    return _move_back(_fit_take(model, near, shape, config, steps_s), origin)


@partial(jax.jit, static_argnames="config")
def _fit_take(
    model: KeypointModel,
    observations: Observations,
    shape: Array | None,
    config: FitConfig,
    steps_s: Array | None,
) -> FitResult:
    take, points = _observe(observations, config.noise)
    state = solve(model, take, _start(model, points, take, shape), config.lm)
    alone = None
    if config.smooth is None:
        sigma = joint_sigma(model, take, state, config.lm)
    else:
        alone = _joints(model, state)
        state, motion = smooth(model, take, state, config.lm, config.smooth, steps_s)
        sigma = smoothed_sigma(model, take, state, config.lm, motion)
    result = _result(model, observations, take, state, sigma, points.sigma_px, config.lm)
    return result if alone is None else result._replace(alone=alone)


def fit_take_adam(
    model: KeypointModel,
    observations: Observations,
    start: AdamParameters | None = None,
    recipe: AdamRecipe = ADAM_300,
    *,
    config: FitConfig = FitConfig(),
    diagonal_px: float = REFERENCE_DIAGONAL_PX,
    silhouettes: SilhouetteTarget | None = None,
) -> FitResult:
    """Fit one hand by the paper's iterative optimisation, every frame by itself; arguments as `fit_take`.

    Args:
        start: parameters with a leading axis of frames; None begins with the flat hand, unturned, at the
            triangulated wrist.
        recipe: static.
        config: its `noise` is used; static.
        diagonal_px: diagonal of the images; the default is that of 1280 x 720.
        silhouettes: masks (frame, view, h, w) and their cameras with a leading axis of frames, a term of its
            own; frames are then fitted one after the other, for drawing them takes memory.

    Returns: as `fit_take`, with `sigma_m` zero: this solver has no uncertainty.
    """
    _check(observations, None, given=False)
    _check_silhouettes(silhouettes, observations.uv_px.shape[:2])
    near, origin = _near_world(model, observations)
    if origin.any():
        start = None if start is None else start._replace(translation=start.translation - origin)
        if silhouettes is not None:
            T = move_origin(silhouettes.cams.T_cam_from_world, origin)
            silhouettes = silhouettes._replace(cams=silhouettes.cams._replace(T_cam_from_world=T))
    result = _fit_take_adam(model, near, start, recipe, config, diagonal_px, silhouettes)
    return _move_back(result, origin)


@partial(jax.jit, static_argnames=("recipe", "config"))
def _fit_take_adam(
    model: KeypointModel,
    observations: Observations,
    start: AdamParameters | None,
    recipe: AdamRecipe,
    config: FitConfig,
    diagonal_px: float | Array,
    silhouettes: SilhouetteTarget | None,
) -> FitResult:
    take, points = _observe(observations, config.noise)
    inliers = take.seen.weights > 0
    given = 1.0 if observations.weights is None else jnp.asarray(observations.weights)
    seen = take.seen._replace(weights=jnp.where(inliers, given, 0).astype(take.seen.weights.dtype))
    if start is None:
        start = jax.vmap(lambda wrist: released_start(None, wrist))(points.points[:, WRIST])

    def one(frame: tuple) -> AdamParameters:
        own, begin, masks = frame
        return adam_fit(model, own, begin, recipe, diagonal_px=diagonal_px, silhouettes=masks)[0]

    frames = (seen, start, silhouettes)
    found = jax.vmap(one)(frames) if silhouettes is None else jax.lax.map(one, frames)
    pose = axis_angle_from_rotation(rotations_from_raw_quaternions(found.quaternions))
    state = TakeState(pose, found.translation, found.shape)
    sigma = jnp.zeros((*pose.shape[:1], NUM_JOINTS))
    return _result(model, observations, take, state, sigma, points.sigma_px, config.lm)


def _near_world(
    model: KeypointModel, observations: Observations
) -> tuple[Observations, Float[np.ndarray, "3"]]:
    """Move a far world near its cameras; return where its new origin lies in the old world."""
    T = observations.T_cam_from_world
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((model, observations)))
    origin = np.zeros(3) if traced else distant_origin(T)
    return observations._replace(T_cam_from_world=move_origin(T, origin) if origin.any() else T), origin


def _move_back(result: FitResult, origin: Float[np.ndarray, "3"]) -> FitResult:
    if not origin.any():
        return result
    moved = {name: getattr(result, name) for name in _PLACES}
    return result._replace(**{name: np.asarray(x, np.float64) + origin for name, x in moved.items()})


def _check(observations: Observations, shape: Array | None, given: bool) -> None:
    uv, weights, K, T = observations
    if uv.ndim != 4 or uv.shape[-2:] != (NUM_JOINTS, 2):
        raise ValueError(f"`uv_px` must have shape (frame, view, 21, 2); got {uv.shape}")
    frames, views = uv.shape[:2]
    if views < 2:
        raise ValueError(f"a fit needs at least two views; got `uv_px` of shape {uv.shape}")
    for name, cameras, size in (("K", K, 3), ("T_cam_from_world", T, 4)):
        if cameras.shape not in ((views, size, size), (frames, views, size, size)):
            raise ValueError(
                f"key points and cameras must have the same views: `{name}` must have shape "
                f"({views}, {size}, {size}), or ({frames}, {views}, {size}, {size}); got {cameras.shape}"
            )
    if weights is not None and weights.shape != uv.shape[:-1]:
        raise ValueError(f"`weights` must have shape {uv.shape[:-1]}; got {weights.shape}")
    if given != (shape is not None):
        raise ValueError(f"`shape` goes with ShapeMode.GIVEN, and only with it; got shape {shape}")
    if shape is not None and shape.shape not in ((NUM_SHAPES,), (frames, NUM_SHAPES)):
        raise ValueError(f"`shape` must have shape (10,) or ({frames}, 10); got {shape.shape}")


def _steps_s(time_s: Array | None, frames: int, config: FitConfig) -> Array | None:
    """Return the time from each frame to the next, subtracted before it is rounded; None = not needed."""
    if config.smooth is None:
        return None
    if time_s is None:
        return np.full(frames - 1, config.smooth.seconds, np.float32)
    if time_s.shape != (frames,):
        raise ValueError(f"`time_s` must have shape ({frames},), one moment a frame; got {time_s.shape}")
    if isinstance(time_s, Tracer):
        return jnp.diff(time_s)
    steps = np.diff(np.asarray(time_s, np.float64))
    wrong = np.flatnonzero(~(steps > 0))
    if wrong.size:
        first = wrong[0]
        raise ValueError(
            "`time_s` must be seconds that grow from frame to frame; got "
            f"{time_s[first]} and {time_s[first + 1]} of frames {first} and {first + 1}"
        )
    return steps.astype(np.float32)


def _check_silhouettes(silhouettes: SilhouetteTarget | None, frames_and_views: tuple[int, int]) -> None:
    if silhouettes is None:
        return
    masks, (K, T, view_mask) = silhouettes.masks, silhouettes.cams
    for name, array, ndim in (
        ("masks", masks, 4),
        ("K", K, 4),
        ("T_cam_from_world", T, 4),
        ("view_mask", view_mask, 2),
    ):
        if array is None or array.ndim != ndim or array.shape[:2] != frames_and_views:
            got = None if array is None else array.shape
            raise ValueError(
                f"`silhouettes` must have leading axes (frame, view) = {frames_and_views}; got `{name}` of "
                f"shape {got}"
            )


def _observe(observations: Observations, noise: KeypointNoise) -> tuple[TakeObservations, RobustPoints]:
    """Triangulate, and keep the key points that agree with it as observations."""
    points = triangulate_robust(observations, noise=noise, frame_axis=0)
    seen = clean(observations, 0)
    kept, variance = points.inlier_mask, points.sigma_px[:, None, None] ** 2
    seen = seen._replace(
        uv_px=jnp.where(kept[..., None], seen.uv_px, 0), weights=jnp.where(kept, seen.weights / variance, 0)
    )
    return TakeObservations(seen, can_be_placed(points.points, points.valid, points.covariance)), points


def _start(
    model: KeypointModel, points: RobustPoints, take: TakeObservations, shape: Array | None
) -> TakeState:
    frames = take.frame_mask.shape[0]
    dtype = points.points.dtype
    known = jnp.zeros(NUM_SHAPES, dtype) if shape is None else jnp.asarray(shape, dtype)
    known = jnp.broadcast_to(known, (frames, NUM_SHAPES))
    pose, wrist = closed_form_pose(model, points.points, points.valid, known)
    keep = take.frame_mask[:, None]
    return TakeState(jnp.where(keep[..., None], pose, 0), jnp.where(keep, wrist, 0), known)


def _result(
    model: KeypointModel,
    observations: Observations,
    take: TakeObservations,
    state: TakeState,
    sigma: Array,
    sigma_px: Array,
    config: LMConfig,
) -> FitResult:
    translation = state.wrist - rest_wrist(model, state.shape)
    mesh = hand_mesh(model.hand, state.pose, state.shape, translation)
    every = clean(observations, 0)
    keypoints = _keypoints(model, state, mesh.joints)
    pixels, _ = projection_jacobian(every.K, every.T_cam_from_world, keypoints)
    counted = every.weights > 0
    distance = jnp.linalg.norm(pixels - jnp.where(counted[..., None], every.uv_px, pixels + 1), axis=-1)
    count = jnp.sum(counted, axis=-1)
    mean = jnp.sum(jnp.where(counted, distance, 0), axis=-1) / jnp.maximum(count, 1)
    finite = jnp.all(jnp.isfinite(mesh.joints), axis=(-2, -1)) & jnp.all(jnp.isfinite(sigma), axis=-1)
    valid = take.frame_mask & finite
    return FitResult(
        state.pose,
        state.shape,
        translation,
        mesh.joints,
        mesh.vertices,
        valid,
        jnp.where((count > 0) & valid[:, None], mean, jnp.nan),
        jnp.where(valid[:, None], sigma, 0),
        take.seen.weights > 0,
        sigma_px,
        jnp.where(valid, frame_cost(model, take, state, config.robust_sigmas, config), jnp.nan),
        keypoints,
        mesh.joints,
    )


def _joints(model: KeypointModel, state: TakeState) -> Float[Array, "frame 21 3"]:
    """Return the joints of a state, without its surface."""
    posed = pose_keypoints(model, state.pose, state.shape)
    return joints_of(model, posed) + state.wrist[:, None]


def _keypoints(model: KeypointModel, state: TakeState, joints: Float[Array, "frame 21 3"]) -> Array:
    """Return where the detector should see the joints."""
    if model.offsets is None:
        return joints
    return pose_keypoints(model, state.pose, state.shape).points + state.wrist[:, None]
