"""The second pass: all frames of a take at once, held together by a random walk of pose and place.

Gauss-Newton over the whole take with first differences as residuals gives a block-tridiagonal system, 51 x 51
per frame, solved exactly by block elimination forwards and backwards (the Rauch-Tung-Striebel smoother in
information form). The shape stays as the first pass left it. Frames without observations are bridged.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from poem_jax.fitting.kinematics import POSE_SIZE, STATE_SIZE, KeypointModel
from poem_jax.fitting.lm import LMConfig, TakeObservations, TakeState, apply_step, normal_equations
from poem_jax.fitting.residuals import smoothness
from poem_jax.geometry.transforms import matmul
from poem_jax.typing import Array, Float


@dataclass(frozen=True)
class SmoothConfig:
    """How far a hand moves from one frame to the next, one standard deviation."""

    sigma_angle: float = 0.05
    """Radians."""
    sigma_m: float = 0.01
    """Metres."""
    iterations: int = 3


def smooth(
    model: KeypointModel, take: TakeObservations, state: TakeState, config: LMConfig, motion: SmoothConfig
) -> TakeState:
    """Return the take's most probable motion near `state`, the shape unchanged."""
    state = _bridged(take, state)

    def step(state: TakeState, _: None) -> tuple[TakeState, None]:
        equations = normal_equations(model, take, state, config.robust_sigmas, config)
        dx = _smoothed_step(equations.H, equations.g, state, motion)
        return apply_step(state, dx, jnp.zeros_like(state.shape)), None

    return jax.lax.scan(step, state, None, length=motion.iterations)[0]


def _smoothed_step(
    H: Float[Array, "frame 51 51"], g: Float[Array, "frame 51"], state: TakeState, motion: SmoothConfig
) -> Float[Array, "frame 51"]:
    """Return the Gauss-Newton step of data and smoothness together."""
    walk = jnp.concatenate(
        [jnp.full(POSE_SIZE, motion.sigma_angle**-1), jnp.full(STATE_SIZE - POSE_SIZE, motion.sigma_m**-1)]
    ).astype(H.dtype)
    change = walk * smoothness(state.pose, state.wrist, motion.sigma_angle, motion.sigma_m)
    g = g.at[1:].add(change).at[:-1].add(-change)
    frames = H.shape[0]
    neighbours = jnp.minimum(jnp.arange(frames), 1) + jnp.minimum(jnp.arange(frames)[::-1], 1)
    diagonal = neighbours[:, None] * walk**2 + 1e-6
    return solve_tridiagonal(H + diagonal[..., None] * jnp.eye(STATE_SIZE, dtype=H.dtype), -(walk**2), -g)


def solve_tridiagonal(
    blocks: Float[Array, "frame n n"], coupling: Float[Array, "n"], right: Float[Array, "frame n"]
) -> Float[Array, "frame n"]:
    """Solve a symmetric block-tridiagonal system whose off-diagonal blocks are all diag(`coupling`)."""
    n = coupling.shape[0]

    def forwards(carry: tuple[Array, Array], frame: tuple[Array, Array]) -> tuple[tuple, tuple]:
        gain, moved = carry
        block, r = frame
        # The previous frame eliminated: x_prev = moved - gain x.
        left = block - coupling[:, None] * gain
        solved = jnp.linalg.solve(
            left, jnp.concatenate([jnp.diag(coupling), (r - coupling * moved)[:, None]], 1)
        )
        after = (solved[:, :n], solved[:, n])
        return after, after

    def backwards(x: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
        gain, moved = frame
        x = moved - matmul(gain, x[:, None])[:, 0]
        return x, x

    zero = (jnp.zeros((n, n), right.dtype), jnp.zeros(n, right.dtype))
    _, eliminated = jax.lax.scan(forwards, zero, (blocks, right))
    _, x = jax.lax.scan(backwards, jnp.zeros(n, right.dtype), eliminated, reverse=True)
    return x


def _bridged(take: TakeObservations, state: TakeState) -> TakeState:
    """Give frames without observations the state of the last one before them that has, or the first."""
    frames = jnp.arange(take.frame_mask.shape[0])
    last = jax.lax.cummax(jnp.where(take.frame_mask, frames, -1))
    first = jnp.argmax(take.frame_mask)
    source = jnp.where(last < 0, first, last)
    return jax.tree.map(lambda x: x[source], state)
