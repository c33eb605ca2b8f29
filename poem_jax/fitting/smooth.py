"""The second pass: all frames of a take at once, held together by a random walk of pose and place.

First differences as residuals couple neighbouring frames: the normal equations are block-tridiagonal, 51 x 51
a frame, with diagonal blocks -W_f beside them (W_f the precision of the step from frame f to f + 1; for the
turn of the wrist, whose steps are small, to first order). Elimination forwards and backwards solves them
exactly (the Rauch-Tung-Striebel smoother in information form). With B_f the blocks on the diagonal and b_f
the right sides,

    G_f = (B_f - W_{f-1} G_{f-1} W_{f-1})^-1,   m_f = G_f (b_f + W_{f-1} m_{f-1}),
    x_f = m_f + G_f W_f x_{f+1},                C_f = G_f + G_f W_f C_{f+1} W_f G_f^T,

C_f the blocks of the inverse: the covariance of frame f. Numbers are in units of the walk of `SmoothConfig`.
The variance of the walk grows with the time between frames, which may be spaced unevenly. A step of the first
pass that is longer than this walk and its own uncertainty explain - a fast hand - is held only as tightly as
it is long. Steps of the solver are Levenberg-Marquardt's: kept
where they lower the cost of the whole take. The shape stays as the first pass left it. Frames without
observations are bridged, and tell nothing.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from poem_jax.fitting.kinematics import POSE_SIZE, STATE_SIZE, KeypointModel
from poem_jax.fitting.lm import (
    LMConfig,
    NormalEquations,
    TakeObservations,
    TakeState,
    apply_step,
    conditional_covariance,
    frame_cost,
    normal_equations,
    posterior_sigma,
    prior_equations,
)
from poem_jax.fitting.residuals import smoothness
from poem_jax.geometry.transforms import matmul, transpose
from poem_jax.typing import Array, Float

_FIRST_DAMPING = 1e-5
_MIN_DAMPING = 1e-6
_MAX_DAMPING = 1e4


@dataclass(frozen=True)
class SmoothConfig:
    """How far a hand moves at rest within a given time, one standard deviation; over longer times as a random
    walk goes."""

    sigma_angle: float = 0.05
    """Radians."""
    sigma_m: float = 0.01
    """Metres."""
    seconds: float = 1 / 30
    """The time in which it goes so far; also from frame to frame where frames have no times."""
    iterations: int = 5


class Eliminated(NamedTuple):
    """A block-tridiagonal matrix, eliminated forwards."""

    gain: Float[Array, "frame n n"]
    """G_f."""
    before: Float[Array, "frame n"]
    """W_{f-1}, zero for the first frame."""
    after: Float[Array, "frame n"]
    """W_f, zero for the last frame."""

    def solve(self, right: Float[Array, "frame n k"]) -> Float[Array, "frame n k"]:
        """Return the solution for right sides (frame, n, k)."""

        def forwards(moved: Array, frame: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            gain, before, b = frame
            moved = matmul(gain, b + before[:, None] * moved)
            return moved, moved

        def backwards(x: Array, frame: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            gain, after, moved = frame
            x = moved + matmul(gain, after[:, None] * x)
            return x, x

        zero = jnp.zeros_like(right[0])
        _, moved = jax.lax.scan(forwards, zero, (self.gain, self.before, right))
        return jax.lax.scan(backwards, zero, (self.gain, self.after, moved), reverse=True)[1]

    def covariance(self) -> Float[Array, "frame n n"]:
        """Return the diagonal blocks of the inverse."""

        def backwards(C: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
            gain, after = frame
            passed = gain * after
            C = gain + matmul(matmul(passed, C), transpose(passed))
            return C, C

        zero = jnp.zeros_like(self.gain[0])
        return jax.lax.scan(backwards, zero, (self.gain, self.after), reverse=True)[1]


def eliminate(blocks: Float[Array, "frame n n"], coupling: Float[Array, "step n"]) -> Eliminated:
    """Eliminate the frames of a positive definite matrix.

    Args:
        blocks: the blocks on its diagonal.
        coupling: W_f; the blocks beside the diagonal are -diag(W_f).
    """
    eye = jnp.eye(blocks.shape[-1], dtype=blocks.dtype)
    before, after = jnp.pad(coupling, ((1, 0), (0, 0))), jnp.pad(coupling, ((0, 1), (0, 0)))

    def forwards(gain: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
        block, before = frame
        left = block - before[:, None] * gain * before
        gain = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(left), True), eye)
        return gain, gain

    return Eliminated(jax.lax.scan(forwards, jnp.zeros_like(blocks[0]), (blocks, before))[1], before, after)


class Motion(NamedTuple):
    """How tightly each step is held."""

    sigma: Float[Array, "51"]
    """The walk at rest: radians, metres."""
    precision: Float[Array, "step 51"]
    """Of every step, in units of this walk: at rest `SmoothConfig.seconds` by the time between the frames,
    less where the hand moves fast."""


def smooth(
    model: KeypointModel,
    take: TakeObservations,
    state: TakeState,
    config: LMConfig,
    walk: SmoothConfig,
    steps_s: Float[Array, "step"],
) -> tuple[TakeState, Motion]:
    """Return the take's most probable motion near `state`, the shape unchanged, and how it was held.

    Args:
        model: The hand.
        take: What is seen of it.
        state: The first pass.
        config: Of the first pass.
        walk: How the hand moves at rest.
        steps_s: The time from each frame to the next, seconds.
    """
    state = _bridged(take, state)
    motion = motion_of(model, take, state, config, walk, steps_s)

    def step(carry: tuple[TakeState, Array], _: None) -> tuple[tuple[TakeState, Array], None]:
        state, damping = carry
        equations = _equations(model, take, state, config)
        dx = _smoothed_step(equations, state, motion, damping)
        trial = apply_step(state, dx, jnp.zeros_like(state.shape))
        costs = [take_cost(model, take, s, config, motion) for s in (state, trial)]
        falls = costs[1] < costs[0]
        state = jax.tree.map(lambda new, old: jnp.where(falls, new, old), trial, state)
        damping = jnp.clip(jnp.where(falls, damping / 4, damping * 64), _MIN_DAMPING, _MAX_DAMPING)
        return (state, damping), None

    begin = (state, jnp.asarray(_FIRST_DAMPING, state.pose.dtype))
    return jax.lax.scan(step, begin, None, length=walk.iterations)[0][0], motion


def motion_of(
    model: KeypointModel,
    take: TakeObservations,
    state: TakeState,
    config: LMConfig,
    walk: SmoothConfig,
    steps_s: Float[Array, "step"],
) -> Motion:
    """Return how tightly to hold each step of `state`, a first pass: by its length, less its noise.

    With C the covariance of a frame and P the prior's part of C^-1, the first pass shows the share
    r = 1 - diag(C P) of a motion, and its noise is diag(C - C P C). Turns and place of a step are each one
    sample of the walk's variance, sum(step^2 - noise) / sum(r^2), never taken below that of `walk` over the
    time between the frames.
    """
    place = jnp.arange(STATE_SIZE) >= POSE_SIZE
    equations = _equations(model, take, state, config)
    sigma = jnp.where(place, walk.sigma_m, walk.sigma_angle).astype(equations.H.dtype)
    C = conditional_covariance(equations)
    believed = matmul(C, prior_equations(model, state, config)[0])
    shown = jnp.clip(1 - jnp.diagonal(believed, axis1=-2, axis2=-1), 0, 1)
    noise = jnp.diagonal(C - matmul(believed, C), axis1=-2, axis2=-1) / sigma**2
    known = (take.frame_mask[1:] & take.frame_mask[:-1])[:, None]
    moved = jnp.where(known, _steps(state, sigma) ** 2 - noise[1:] - noise[:-1], 0)
    shown = jnp.where(known, shown[1:] * shown[:-1], 1)
    turns, moves = (
        jnp.sum(moved[:, part], -1, keepdims=True) / jnp.sum(shown[:, part], -1, keepdims=True)
        for part in (slice(0, POSE_SIZE), slice(POSE_SIZE, None))
    )
    at_rest = (steps_s / walk.seconds).astype(sigma.dtype)[:, None]
    return Motion(sigma, 1 / jnp.maximum(jnp.where(place, moves, turns), at_rest))


def take_cost(
    model: KeypointModel, take: TakeObservations, state: TakeState, config: LMConfig, motion: Motion
) -> Float[Array, ""]:
    """Return what `smooth` lowers: the cost of all frames seen and of the steps between all frames."""
    frames = frame_cost(model, take, state, config.robust_sigmas, config)
    frames = jnp.where(take.frame_mask & jnp.isfinite(frames), frames, 0)
    return jnp.sum(frames) + 0.5 * jnp.sum(motion.precision * _steps(state, motion.sigma) ** 2)


def smoothed_sigma(
    model: KeypointModel, take: TakeObservations, state: TakeState, config: LMConfig, motion: Motion
) -> Float[Array, "frame 21"]:
    """Return the standard deviation of one coordinate of every joint, metres; all frames tell of each."""
    equations = _equations(model, take, state, config)
    sigma = motion.sigma
    chain = eliminate(_blocks(equations.H, motion, 0), motion.precision)
    covariance = sigma[:, None] * chain.covariance() * sigma
    solved = sigma[:, None] * chain.solve(sigma[:, None] * equations.H_shape)
    return posterior_sigma(equations, covariance, solved, take, state, config)


def _equations(
    model: KeypointModel, take: TakeObservations, state: TakeState, config: LMConfig
) -> NormalEquations:
    """Linearise; frames that are not seen, or not finite, tell nothing."""
    equations = normal_equations(model, take, state, config.robust_sigmas, config)
    told = take.frame_mask & jnp.all(jnp.isfinite(equations.H), (-2, -1))
    told = told & jnp.all(jnp.isfinite(equations.g), -1)
    return jax.tree.map(
        lambda array: jnp.where(told.reshape(told.shape + (1,) * (array.ndim - 1)), array, 0), equations
    )


def _smoothed_step(
    equations: NormalEquations, state: TakeState, motion: Motion, damping: Array
) -> Float[Array, "frame 51"]:
    """Return the damped Gauss-Newton step of data and smoothness together."""
    change = motion.precision * _steps(state, motion.sigma)
    g = (motion.sigma * equations.g).at[1:].add(change).at[:-1].add(-change)
    chain = eliminate(_blocks(equations.H, motion, damping), motion.precision)
    return motion.sigma * chain.solve(-g[..., None])[..., 0]


def _steps(state: TakeState, sigma: Float[Array, "51"]) -> Float[Array, "step 51"]:
    """Return the steps between frames, in units of the walk."""
    return smoothness(state.pose, state.wrist, 1.0, 1.0) / sigma


def _blocks(
    H: Float[Array, "frame 51 51"], motion: Motion, damping: Array | float
) -> Float[Array, "frame 51 51"]:
    """Return the diagonal blocks in units of the walk, the coupling to the neighbours included."""
    H = motion.sigma[:, None] * H * motion.sigma
    held = jnp.pad(motion.precision, ((1, 0), (0, 0))) + jnp.pad(motion.precision, ((0, 1), (0, 0)))
    diagonal = held + damping * jnp.diagonal(H, 0, -2, -1) + 1e-6
    return H + jnp.eye(STATE_SIZE, dtype=H.dtype) * diagonal[..., None]


def _bridged(take: TakeObservations, state: TakeState) -> TakeState:
    """Give frames without observations the place of the last one before them that has, or the first."""
    frames = jnp.arange(take.frame_mask.shape[0])
    last = jax.lax.cummax(jnp.where(take.frame_mask, frames, -1))
    first = jnp.argmax(take.frame_mask)
    source = jnp.where(last < 0, first, last)
    return TakeState(state.pose[source], state.wrist[source], state.shape)
