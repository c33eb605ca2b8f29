"""Levenberg-Marquardt over pose, place and shape of a whole take: fixed iterations, exact derivatives.

Letters: F = frames; x = the 51 numbers of a frame (wrist's turn as a small world vector, fingers' axis-angle,
wrist's place); beta = shape, 10; H, g = normal matrix and gradient; D = d joints / d x. Pixel residuals enter
through each joint's information A = sum_v w J_v^T J_v, so that H = D^T A D needs no per-view Jacobian. A
shape shared by all frames is eliminated exactly (Schur complement): sum_f (H_bb - H_bx H_xx^-1 H_xb) 10x10.

Why not a library. optimistix and jaxopt solve one problem with an adaptive loop: under `vmap` every frame
then pays for the slowest, and their dense solvers see a Jacobian (2 V 21 + 116 rows of 61), not these 3x3
blocks, nor a shape shared over frames. What is needed is a fixed-count, masked loop around one Cholesky a
frame.
"""

import enum
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.fitting.kinematics import (
    POSE_SIZE,
    STATE_SIZE,
    KeypointModel,
    pose_jacobian,
    pose_keypoints,
    shape_jacobian,
)
from poem_jax.fitting.observations import Observations, point_information
from poem_jax.fitting.residuals import (
    LIMIT_SIGMA,
    MIN_PRIOR_SIGMA,
    geman_mcclure,
    geman_mcclure_weight,
    joint_limits,
    pose_prior,
    prior_sigma,
    reprojection,
    shape_prior,
)
from poem_jax.geometry.transforms import axis_angle_from_rotation, matmul, rotation_from_axis_angle, transpose
from poem_jax.hand.joint_limits import anatomical_angles
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES, NUM_SKELETON_JOINTS
from poem_jax.typing import Array, Bool, Float

_MIN_DAMPING = 1e-5
_FIRST_DAMPING = 1e-3
_MAX_DAMPING = 1e4
_MAX_TURN = 0.5
_MAX_MOVE = 0.1
"""Bounds of one step: radians and metres."""


class ShapeMode(enum.StrEnum):
    """What is known of the shape."""

    GIVEN = "given"
    SHARED = "shared"
    """Unknown, the same in all frames of the take."""
    PER_FRAME = "per_frame"


@dataclass(frozen=True)
class LMConfig:
    """Static settings of the solver."""

    iterations: int = 10
    shape_mode: ShapeMode | str = ShapeMode.SHARED
    robust_sigmas: float = 5.0
    """Where the robust kernel cuts off, in standard deviations of a key point."""
    first_robust_sigmas: float = 50.0
    """The same at the first iteration; it falls to `robust_sigmas` over the first half."""
    prior_weight: float = 0.5
    """Of the pose prior; 1 takes half of each joint's range as a standard deviation."""
    limit_sigma: float = LIMIT_SIGMA
    """Radians; how softly joints are stopped beyond their limits."""
    min_prior_sigma: float = MIN_PRIOR_SIGMA
    """Radians; no angle is held tighter than this by the prior."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape_mode", ShapeMode(self.shape_mode))


class TakeObservations(NamedTuple):
    """The key points of a take, and the frames that count."""

    seen: Observations
    """Clean, with a leading axis of frames; weights are confidence / sigma_px^2, zero for outliers."""
    frame_mask: Bool[Array, "frame"]
    """False: the frame keeps its start, and says nothing about the shape, which it takes from the others."""


class TakeState(NamedTuple):
    """What the solver moves."""

    pose: Float[Array, "frame 16 3"]
    wrist: Float[Array, "frame 3"]
    """Metres, world frame."""
    shape: Float[Array, "frame 10"]


class NormalEquations(NamedTuple):
    """Second-order model of the cost at a state, frame by frame."""

    H: Float[Array, "frame 51 51"]
    g: Float[Array, "frame 51"]
    H_shape: Float[Array, "frame 51 10"]
    S: Float[Array, "frame 10 10"]
    g_shape: Float[Array, "frame 10"]
    """Without the shape's prior."""
    D: Float[Array, "frame 21 3 51"]
    """D and D_shape: derivatives of the hand's own joints, whatever the offsets of a detector."""
    D_shape: Float[Array, "frame 21 3 10"]


def solve(model: KeypointModel, take: TakeObservations, start: TakeState, config: LMConfig) -> TakeState:
    """Run the fixed number of iterations from `start`; frames outside `frame_mask` keep their start."""
    scales = _robust_schedule(config).astype(start.pose.dtype)
    damping = jnp.full(take.frame_mask.shape, _FIRST_DAMPING, start.pose.dtype)

    def step(carry: tuple[TakeState, Array], scale: Array) -> tuple[tuple[TakeState, Array], None]:
        return _iteration(model, take, *carry, scale, config), None

    (state, _), _ = jax.lax.scan(step, (start, damping), scales)
    return state


def joint_sigma(
    model: KeypointModel, take: TakeObservations, state: TakeState, config: LMConfig
) -> Float[Array, "frame 21"]:
    """Return the standard deviation of one coordinate of every joint, metres, given all observations."""
    equations = normal_equations(model, take, state, config.robust_sigmas, config)
    covariance = conditional_covariance(equations)
    return posterior_sigma(equations, covariance, matmul(covariance, equations.H_shape), take, state, config)


def conditional_covariance(equations: NormalEquations) -> Float[Array, "frame 51 51"]:
    """Return the covariance of every frame's 51 numbers given the shape: H^-1."""
    H = equations.H
    factor = _factor(H, jnp.full(H.shape[:1], _MIN_DAMPING, H.dtype))
    return _solve(factor, jnp.broadcast_to(jnp.eye(STATE_SIZE, dtype=H.dtype), H.shape))


def posterior_sigma(
    equations: NormalEquations,
    covariance: Float[Array, "frame 51 51"],
    solved: Float[Array, "frame 51 10"],
    take: TakeObservations,
    state: TakeState,
    config: LMConfig,
) -> Float[Array, "frame 21"]:
    """Return the standard deviation of one coordinate of every joint, metres.

    sqrt(trace / 3) of D C D^T, plus what the shape's own uncertainty adds where it is estimated.

    Args:
        equations: at `state`.
        covariance: C, of x given the shape.
        solved: C H_shape over all frames together, by how much x follows the shape.
    """
    D = equations.D.reshape(-1, NUM_JOINTS * 3, STATE_SIZE)
    variance = jnp.sum(matmul(D, covariance) * D, axis=-1)
    if config.shape_mode is not ShapeMode.GIVEN:
        schur, _ = _reduced_shape(equations, solved, None, take, state, config)
        moved = equations.D_shape.reshape(-1, NUM_JOINTS * 3, NUM_SHAPES) - matmul(D, solved)
        variance = variance + jnp.sum(moved * matmul(moved, jnp.linalg.inv(schur)), axis=-1)
    variance = variance.reshape(-1, NUM_JOINTS, 3)
    return jnp.sqrt(jnp.maximum(jnp.mean(variance, axis=-1), 0))


def normal_equations(
    model: KeypointModel, take: TakeObservations, state: TakeState, scale: float | Array, config: LMConfig
) -> NormalEquations:
    """Linearise all residuals at `state`, key points reweighted by the robust kernel of the given scale."""
    posed = pose_keypoints(model, state.pose, state.shape)
    robust = partial(geman_mcclure_weight, scale=scale)
    A, b = point_information(posed.points + state.wrist[..., None, :], take.seen, robust)
    turn = pose_jacobian(model, posed, state.pose)
    place = jnp.broadcast_to(jnp.eye(3, dtype=turn.dtype), (*turn.shape[:-1], 3))
    D, D_shape = jnp.concatenate([turn, place], axis=-1), shape_jacobian(model, posed)
    both = jnp.concatenate([D, D_shape], axis=-1)
    weighted = jnp.sum(A[..., :, :, None] * both[..., None, :, :], axis=-2)
    rows = (both.shape[0], NUM_JOINTS * 3, STATE_SIZE + NUM_SHAPES)
    H = matmul(jnp.swapaxes(both.reshape(rows), -1, -2), weighted.reshape(rows))
    g = jnp.sum(both * b[..., None], axis=(-3, -2))
    prior_H, prior_g = prior_equations(model, state, config)
    x = slice(0, STATE_SIZE)
    y = slice(STATE_SIZE, None)
    if model.offsets is not None:
        bare = model._replace(offsets=None)
        turn = pose_jacobian(bare, pose_keypoints(bare, state.pose, state.shape), state.pose)
        D = jnp.concatenate([turn, place], axis=-1)
    return NormalEquations(
        H[:, x, x] + prior_H, g[:, x] + prior_g, H[:, x, y], H[:, y, y], g[:, y], D, D_shape
    )


def frame_cost(
    model: KeypointModel, take: TakeObservations, state: TakeState, scale: float | Array, config: LMConfig
) -> Float[Array, "frame"]:
    """Return the cost of every frame without the shape's prior."""
    posed = pose_keypoints(model, state.pose, state.shape)
    joints = posed.points + state.wrist[..., None, :]
    pixels = reprojection(joints, take.seen)
    data = jnp.sum(geman_mcclure(jnp.sum(pixels**2, axis=-1), scale), axis=(-2, -1))
    angles = anatomical_angles(state.pose, model.axes)
    prior = jnp.sum(pose_prior(angles, model.limits, config.min_prior_sigma) ** 2, axis=(-2, -1))
    limits = jnp.sum(joint_limits(angles, model.limits, config.limit_sigma) ** 2, axis=(-2, -1))
    return 0.5 * (data + config.prior_weight * prior + limits)


def _iteration(
    model: KeypointModel,
    take: TakeObservations,
    state: TakeState,
    damping: Float[Array, "frame"],
    scale: Array,
    config: LMConfig,
) -> tuple[TakeState, Float[Array, "frame"]]:
    """Try one damped step; keep it where it lowers the cost, and adapt the damping."""
    equations = normal_equations(model, take, state, scale, config)
    dx, dshape = _damped_step(equations, take, state, damping, config)
    trial = apply_step(state, dx, dshape)
    before = frame_cost(model, take, state, scale, config)
    after = frame_cost(model, take, trial, scale, config)
    after = jnp.where(jnp.isfinite(after), after, jnp.inf)
    if config.shape_mode is ShapeMode.SHARED:
        reshaped = state._replace(shape=trial.shape)
        held = frame_cost(model, take, reshaped, scale, config)
        moves, reshapes = _accepted_together(before, after, held, take, state, trial)
    else:
        old, new = (0.5 * jnp.sum(shape_prior(s.shape) ** 2, axis=-1) for s in (state, trial))
        moves = reshapes = (after + new < before + old) & take.frame_mask
    chosen = TakeState(moves, moves, reshapes)
    state = jax.tree.map(
        lambda new, old, take_it: jnp.where(_along(take_it, new), new, old), trial, state, chosen
    )
    damping = jnp.where((after < before) & moves, damping / 4, damping * 8)
    return state, jnp.clip(damping, _MIN_DAMPING, _MAX_DAMPING)


def _accepted_together(
    before: Float[Array, "frame"],
    after: Float[Array, "frame"],
    held: Float[Array, "frame"],
    take: TakeObservations,
    state: TakeState,
    trial: TakeState,
) -> tuple[Bool[Array, "frame"], Bool[Array, "frame"]]:
    """Tell which frames move, and whether all take the new shape, which they share.

    A frame that would get worse by moving keeps its place under the new shape (cost `held`), so that one wild
    frame cannot hold back the take; the shape is taken if the sum falls.
    """
    better = (after < held) | ~jnp.isfinite(held)
    counted = take.frame_mask & jnp.isfinite(before)
    change = jnp.where(better, after, held) - before
    old, new = (0.5 * jnp.sum(shape_prior(s.shape[0]) ** 2) for s in (state, trial))
    falls = jnp.sum(jnp.where(counted & jnp.isfinite(change), change, 0)) + new - old < 0
    return better & jnp.isfinite(after) & take.frame_mask & falls, jnp.broadcast_to(falls, before.shape)


def _damped_step(
    equations: NormalEquations, take: TakeObservations, state: TakeState, damping: Array, config: LMConfig
) -> tuple[Float[Array, "frame 51"], Float[Array, "frame 10"]]:
    factor = _factor(equations.H, damping)
    if config.shape_mode is ShapeMode.GIVEN:
        return -_solve(factor, equations.g[..., None])[..., 0], jnp.zeros_like(state.shape)
    right = _solve(factor, jnp.concatenate([equations.g[..., None], equations.H_shape], axis=-1))
    schur, g = _reduced_shape(equations, right[..., 1:], right[..., 0], take, state, config)
    dshape = -jnp.linalg.solve(schur, g[..., None])[..., 0]
    dx = -right[..., 0] - matmul(right[..., 1:], dshape[..., None])[..., 0]
    return dx, dshape


def _reduced_shape(
    equations: NormalEquations,
    solved: Float[Array, "frame 51 10"],
    solved_g: Float[Array, "frame 51"] | None,
    take: TakeObservations,
    state: TakeState,
    config: LMConfig,
) -> tuple[Float[Array, "frame 10 10"], Float[Array, "frame 10"]]:
    """Return normal matrix and gradient of the shape with x eliminated, its prior included."""
    across = jnp.swapaxes(equations.H_shape, -1, -2)
    S = equations.S - matmul(across, solved)
    g = equations.g_shape
    if solved_g is not None:
        g = g - matmul(across, solved_g[..., None])[..., 0]
    counted = take.frame_mask & jnp.all(jnp.isfinite(S), (-2, -1)) & jnp.all(jnp.isfinite(g), -1)
    S, g = jnp.where(counted[:, None, None], S, 0), jnp.where(counted[:, None], g, 0)
    if config.shape_mode is ShapeMode.SHARED:
        S, g = (jnp.broadcast_to(jnp.sum(x, 0, keepdims=True), x.shape) for x in (S, g))
    return S + jnp.eye(NUM_SHAPES, dtype=S.dtype), g + shape_prior(state.shape)


def prior_equations(
    model: KeypointModel, state: TakeState, config: LMConfig
) -> tuple[Float[Array, "frame 51 51"], Float[Array, "frame 51"]]:
    """Return normal matrix and gradient of pose prior and limits, both diagonal in anatomical angles."""
    angles = anatomical_angles(state.pose, model.axes)
    excess = joint_limits(angles, model.limits, config.limit_sigma)
    sigma = prior_sigma(model.limits, config.min_prior_sigma)
    prior = pose_prior(angles, model.limits, config.min_prior_sigma)
    slope = config.prior_weight * prior / sigma + excess / config.limit_sigma
    curvature = config.prior_weight / sigma**2 + (excess != 0) / config.limit_sigma**2
    g = jnp.sum(slope[..., None] * model.axes, axis=-2).reshape(-1, POSE_SIZE - 3)
    blocks = matmul(transpose(model.axes) * curvature[:, :, None, :], model.axes)
    eye = jnp.eye(NUM_SKELETON_JOINTS - 1, dtype=blocks.dtype)
    H = (blocks[:, :, :, None, :] * eye[:, None, :, None]).reshape(-1, POSE_SIZE - 3, POSE_SIZE - 3)
    return jnp.pad(H, ((0, 0), (3, 3), (3, 3))), jnp.pad(g, ((0, 0), (3, 3)))


class _Factor(NamedTuple):
    cholesky: Float[Array, "frame 51 51"]
    scale: Float[Array, "frame 51"]


def _factor(H: Float[Array, "frame 51 51"], damping: Float[Array, "frame"]) -> _Factor:
    """Scale H to a unit diagonal, damp it, and take its Cholesky factor."""
    diagonal = jnp.diagonal(H, axis1=-2, axis2=-1)
    scale = 1 / jnp.sqrt(jnp.maximum(diagonal, 1e-6 * jnp.max(diagonal, -1, keepdims=True) + 1e-12))
    eye = jnp.eye(STATE_SIZE, dtype=H.dtype)
    scaled = H * scale[..., :, None] * scale[..., None, :]
    return _Factor(jnp.linalg.cholesky(scaled + (damping[..., None, None] + 1e-6) * eye), scale)


def _solve(factor: _Factor, right: Float[Array, "frame 51 k"]) -> Float[Array, "frame 51 k"]:
    """Return H^-1 right."""
    solved = jax.scipy.linalg.cho_solve((factor.cholesky, True), right * factor.scale[..., None])
    return solved * factor.scale[..., None]


def apply_step(state: TakeState, dx: Float[Array, "frame 51"], dshape: Float[Array, "frame 10"]) -> TakeState:
    """Apply a step: the wrist turns in the world, everything else adds up; long steps are cut."""
    turn = jnp.clip(dx[:, :POSE_SIZE].reshape(-1, NUM_SKELETON_JOINTS, 3), -_MAX_TURN, _MAX_TURN)
    R = matmul(rotation_from_axis_angle(turn[:, 0]), rotation_from_axis_angle(state.pose[:, 0]))
    pose = jnp.concatenate([axis_angle_from_rotation(R)[:, None], state.pose[:, 1:] + turn[:, 1:]], axis=1)
    wrist = state.wrist + jnp.clip(dx[:, POSE_SIZE:], -_MAX_MOVE, _MAX_MOVE)
    return TakeState(pose, wrist, state.shape + dshape)


def _robust_schedule(config: LMConfig) -> Float[Array, "iteration"]:
    """Return the robust kernel's scale of every iteration."""
    falling = max(config.iterations // 2, 1)
    down = np.geomspace(config.first_robust_sigmas, config.robust_sigmas, falling)
    return jnp.asarray(np.concatenate([down, np.full(config.iterations - falling, config.robust_sigmas)]))


def _along(mask: Array, array: Array) -> Array:
    return mask.reshape(mask.shape + (1,) * (array.ndim - 1))
