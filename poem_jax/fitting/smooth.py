"""The second pass: all frames of a take at once, held together by a random walk of pose and place.

Measured in standard deviations of the walk, first differences as residuals couple neighbouring frames by -1:
the normal equations are block-tridiagonal, 51 x 51 a frame, off-diagonal blocks -I, and elimination forwards
and backwards solves them exactly (the Rauch-Tung-Striebel smoother in information form). With B_f the
diagonal blocks and b_f the right sides,

    G_f = (B_f - G_{f-1})^-1,   m_f = G_f (b_f + m_{f-1}),   x_f = m_f + G_f x_{f+1},
    C_f = G_f + G_f C_{f+1} G_f^T,

C_f the blocks of the inverse: the covariance of frame f. Steps are Levenberg-Marquardt's: kept where they
lower the cost of the whole take. The shape stays as the first pass left it. Frames without observations are
bridged.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from poem_jax.fitting.kinematics import POSE_SIZE, STATE_SIZE, KeypointModel
from poem_jax.fitting.lm import (
    LMConfig,
    TakeObservations,
    TakeState,
    apply_step,
    frame_cost,
    normal_equations,
    posterior_sigma,
)
from poem_jax.fitting.residuals import smoothness
from poem_jax.geometry.transforms import matmul, transpose
from poem_jax.typing import Array, Float

_FIRST_DAMPING = 1e-5
_LEAST_DAMPING = 1e-6
_MOST_DAMPING = 1e4


@dataclass(frozen=True)
class SmoothConfig:
    """How far a hand moves from one frame to the next, one standard deviation."""

    sigma_angle: float = 0.05
    """Radians."""
    sigma_m: float = 0.01
    """Metres."""
    iterations: int = 5


class Eliminated(NamedTuple):
    """A block-tridiagonal matrix with off-diagonal blocks -I, eliminated forwards."""

    gain: Float[Array, "frame n n"]
    """G_f."""

    def solve(self, right: Float[Array, "frame n k"]) -> Float[Array, "frame n k"]:
        """Return the solution for right sides (frame, n, k)."""

        def forwards(moved: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
            gain, b = frame
            moved = matmul(gain, b + moved)
            return moved, moved

        def backwards(x: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
            gain, moved = frame
            x = moved + matmul(gain, x)
            return x, x

        zero = jnp.zeros_like(right[0])
        _, moved = jax.lax.scan(forwards, zero, (self.gain, right))
        return jax.lax.scan(backwards, zero, (self.gain, moved), reverse=True)[1]

    def covariance(self) -> Float[Array, "frame n n"]:
        """Return the diagonal blocks of the inverse."""

        def backwards(after: Array, gain: Array) -> tuple[Array, Array]:
            own = gain + matmul(matmul(gain, after), transpose(gain))
            return own, own

        return jax.lax.scan(backwards, jnp.zeros_like(self.gain[0]), self.gain, reverse=True)[1]


def eliminate(blocks: Float[Array, "frame n n"]) -> Eliminated:
    """Eliminate the frames of a positive definite matrix with these diagonal blocks, -I beside them."""
    eye = jnp.eye(blocks.shape[-1], dtype=blocks.dtype)

    def forwards(gain: Array, block: Array) -> tuple[Array, Array]:
        gain = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(block - gain), True), eye)
        return gain, gain

    return Eliminated(jax.lax.scan(forwards, jnp.zeros_like(blocks[0]), blocks)[1])


def smooth(
    model: KeypointModel, take: TakeObservations, state: TakeState, config: LMConfig, motion: SmoothConfig
) -> TakeState:
    """Return the take's most probable motion near `state`, the shape unchanged."""

    def step(carry: tuple[TakeState, Array], _: None) -> tuple[tuple[TakeState, Array], None]:
        state, damping = carry
        equations = normal_equations(model, take, state, config.robust_sigmas, config)
        dx = _smoothed_step(equations.H, equations.g, state, motion, damping)
        trial = apply_step(state, dx, jnp.zeros_like(state.shape))
        costs = [take_cost(model, take, s, config, motion) for s in (state, trial)]
        falls = costs[1] < costs[0]
        state = jax.tree.map(lambda new, old: jnp.where(falls, new, old), trial, state)
        damping = jnp.clip(jnp.where(falls, damping / 4, damping * 64), _LEAST_DAMPING, _MOST_DAMPING)
        return (state, damping), None

    begin = (_bridged(take, state), jnp.asarray(_FIRST_DAMPING, state.pose.dtype))
    return jax.lax.scan(step, begin, None, length=motion.iterations)[0][0]


def take_cost(
    model: KeypointModel, take: TakeObservations, state: TakeState, config: LMConfig, motion: SmoothConfig
) -> Float[Array, ""]:
    """Return what `smooth` lowers: the cost of all frames and of the steps between them."""
    frames = frame_cost(model, take, state, config.robust_sigmas, config)
    steps = smoothness(state.pose, state.wrist, motion.sigma_angle, motion.sigma_m)
    return jnp.sum(frames) + 0.5 * jnp.sum(steps**2)


def smoothed_sigma(
    model: KeypointModel, take: TakeObservations, state: TakeState, config: LMConfig, motion: SmoothConfig
) -> Float[Array, "frame 21"]:
    """Return the standard deviation of one coordinate of every joint, metres; all frames tell of each."""
    equations = normal_equations(model, take, state, config.robust_sigmas, config)
    sigma = _walk_sigma(motion, equations.H.dtype)
    chain = eliminate(_blocks(equations.H, sigma, 0))
    covariance = sigma[:, None] * chain.covariance() * sigma
    solved = sigma[:, None] * chain.solve(sigma[:, None] * equations.H_shape)
    return posterior_sigma(equations, covariance, solved, take, state, config)


def _smoothed_step(
    H: Float[Array, "frame 51 51"],
    g: Float[Array, "frame 51"],
    state: TakeState,
    motion: SmoothConfig,
    damping: Array,
) -> Float[Array, "frame 51"]:
    """Return the damped Gauss-Newton step of data and smoothness together."""
    sigma = _walk_sigma(motion, H.dtype)
    change = smoothness(state.pose, state.wrist, motion.sigma_angle, motion.sigma_m)
    g = (sigma * g).at[1:].add(change).at[:-1].add(-change)
    return sigma * eliminate(_blocks(H, sigma, damping)).solve(-g[..., None])[..., 0]


def _blocks(
    H: Float[Array, "frame 51 51"], sigma: Float[Array, "51"], damping: Array | float
) -> Float[Array, "frame 51 51"]:
    """Return the diagonal blocks in units of the walk, the coupling to the neighbours included."""
    count = jnp.arange(H.shape[0])
    neighbours = jnp.minimum(count, 1) + jnp.minimum(count[::-1], 1)
    H = sigma[:, None] * H * sigma
    eye = jnp.eye(STATE_SIZE, dtype=H.dtype)
    return H + eye * (neighbours[:, None, None] + damping * jnp.diagonal(H, 0, -2, -1)[..., None] + 1e-6)


def _walk_sigma(motion: SmoothConfig, dtype: jnp.dtype) -> Float[Array, "51"]:
    place = jnp.arange(STATE_SIZE) >= POSE_SIZE
    return jnp.where(place, motion.sigma_m, motion.sigma_angle).astype(dtype)


def _bridged(take: TakeObservations, state: TakeState) -> TakeState:
    """Give frames without observations the state of the last one before them that has, or the first."""
    frames = jnp.arange(take.frame_mask.shape[0])
    last = jax.lax.cummax(jnp.where(take.frame_mask, frames, -1))
    first = jnp.argmax(take.frame_mask)
    source = jnp.where(last < 0, first, last)
    return jax.tree.map(lambda x: x[source], state)
