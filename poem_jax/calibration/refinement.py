"""Extrinsics of a rig, corrected from the hands that its cameras saw: a bundle adjustment.

All joints of all frames, all cameras but for a weak hold to where they were, and the bones' lengths, which do
not change in a take, are found together (Triggs et al. 1999). Letters: c = 6 numbers of each camera (turned
about its own centre, moved in its own frame), b = the logarithm of every bone's length, x = the joints of a
hand in a frame. Hands share nothing but c and b, so the normal equations are solved for (c, b) with each
hand's joints eliminated (Schur complement), hand by hand.

Key points fix neither the world nor its scale. Both are those in which most cameras stand where they stood:
the similarity is fitted to all cameras with a robust loss, so that one that was moved moves no other.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.calibration.held_world import camera_moves, world_as_given
from poem_jax.calibration.meeting_points import meeting_points, near_rig
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import (
    rigid,
    rotation_from_axis_angle,
    skew_matrix,
    transform_points,
)
from poem_jax.typing import Array, Bool, Float

MAX_HANDS = 96
"""Hands in single frames that are adjusted together."""

_STEPS = 40
_BONE_SHARE = 0.03
"""Standard deviation of a bone's length from frame to frame, as a share: what a detector makes of it."""
_HOLD = (np.radians(5.0), 0.05)
"""Radians, and a share of the rig's extent, by which cameras are off without a doubt: it holds the world."""
_CONVERGED = 1e-7


class _State(NamedTuple):
    T: Float[Array, "view 4 4"]
    points: Float[Array, "hand joint 3"]
    log_bones: Float[Array, "group bone"]


class _Problem(NamedTuple):
    K: Float[Array, "view 3 3"]
    T_given: Float[Array, "view 4 4"]
    ideal_px: Float[Array, "hand view joint 2"]
    seen: Bool[Array, "hand view joint"]
    known: Bool[Array, "hand joint"]
    """Joints that two views see."""
    group: Array
    """Which person's hand each is: those of a group share their bones."""
    bones: Array
    sigma_px: float


class _Normal(NamedTuple):
    """The normal equations [[A, C], [C^T, B]] of what is shared and each hand's joints, filled in place."""

    A: Float[Array, "shared shared"]
    a: Float[Array, " shared"]
    B: Float[Array, "hand joint 3 joint 3"]
    b: Float[Array, "hand joint 3"]
    C: Float[Array, "hand shared joint 3"]


def adjust_extrinsics(
    rig: Rig,
    ideal_px: Float[Array, "hand view joint 2"],
    group: Array,
    bones: tuple[tuple[int, int], ...],
) -> Rig:
    """Return the rig with its extrinsics adjusted to the hands.

    Args:
        rig: The cameras, in any unit and any world.
        ideal_px: Key points of the undistorted images (`epipolar.ideal_keypoints`); NaN = unseen.
        group: For each hand, the number (from 0) of the hand whose bones it shares.
        bones: Pairs of joints.

    Returns: The rig; its world and its scale are those in which most cameras did not move.
    """
    near, extent = near_rig(rig)
    points, valid = meeting_points(near, ideal_px)
    seen = np.isfinite(ideal_px).all(-1) & valid[:, None]
    problem = _Problem(
        near.K, near.T_cam_from_world, np.nan_to_num(ideal_px), seen, valid, group, np.array(bones), 1.0
    )
    state = _State(near.T_cam_from_world, points, _bone_lengths(problem, points))
    state = _solved(problem._replace(sigma_px=_noise_px(problem, state)), state)
    T = world_as_given(near.T_cam_from_world, state.T).copy()
    T[:, :3, 3] *= extent
    return rig._replace(T_cam_from_world=T @ rig.T_cam_from_world[0])


def _solved(problem: _Problem, state: _State) -> _State:
    """Iterate Levenberg-Marquardt; robust weights and the noise are taken anew with every step."""
    damping, cost = 1e-3, _cost(problem, state)
    for _ in range(_STEPS):
        tried = _step(problem, state, damping)
        new = _cost(problem, tried)
        if new < cost:
            small = cost - new < _CONVERGED * cost
            state, damping = tried, damping / 5
            problem = problem._replace(sigma_px=_noise_px(problem, state))
            cost = _cost(problem, state)
            if small:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return state


def _residuals(problem: _Problem, state: _State) -> tuple[Array, Array, Array]:
    """Return pixels (hand, view, joint, 2), bones (hand, bone) and hold (view, 6), in standard deviations."""
    uv, depth = _project(problem.K, state.T, state.points)
    pixels = (uv - problem.ideal_px) / problem.sigma_px
    pixels = np.where((problem.seen & (depth > 0))[..., None], pixels, 0.0)
    a, b = problem.bones.T
    length = np.linalg.norm(state.points[:, a] - state.points[:, b], axis=-1)
    both = problem.known[:, a] & problem.known[:, b]
    bones = (np.log(np.maximum(length, 1e-9)) - state.log_bones[problem.group]) / _BONE_SHARE
    return pixels, np.where(both, bones, 0.0), camera_moves(problem.T_given, state.T) / _hold()


def _cost(problem: _Problem, state: _State) -> float:
    """Return the negative logarithm of the likelihood, tails as of Student's t with two degrees."""
    pixels, bones, hold = _residuals(problem, state)
    count = problem.seen.sum()
    robust = 1.5 * np.log1p((pixels**2).sum(-1) / 2).sum() + 1.5 * np.log1p(bones**2 / 2).sum()
    return float(robust + 0.5 * (hold**2).sum() + 2 * count * np.log(problem.sigma_px))


def _step(problem: _Problem, state: _State, damping: float) -> _State:
    """Return the state after one damped Gauss-Newton step with each hand's joints eliminated."""
    hands, views, joints = problem.seen.shape
    shared, size = 6 * views + state.log_bones.size, 3 * joints
    normal = _Normal(
        np.zeros((shared, shared)),
        np.zeros(shared),
        np.zeros((hands, joints, 3, joints, 3)),
        np.zeros((hands, joints, 3)),
        np.zeros((hands, shared, joints, 3)),
    )
    pixels, bones, hold = _residuals(problem, state)
    _add_pixels(normal, problem, state, pixels)
    _add_bones(normal, problem, state, bones)
    held = np.arange(6 * views)
    normal.A[held, held] += np.tile(1 / _hold() ** 2, views)
    normal.a[held] += (hold / _hold()).ravel()
    B, b = normal.B.reshape(hands, size, size), normal.b.reshape(hands, size)
    C = normal.C.reshape(hands, shared, size)
    B[:, np.arange(size), np.arange(size)] *= 1 + damping
    B[:, np.arange(size), np.arange(size)] += 1e-9
    normal.A[np.diag_indices(shared)] *= 1 + damping
    normal.A[np.diag_indices(shared)] += 1e-9
    solved = np.linalg.solve(B, np.concatenate([np.swapaxes(C, 1, 2), b[..., None]], -1))
    schur = normal.A - np.einsum("hgs,hsk->gk", C, solved[..., :-1], optimize=True)
    change = np.linalg.solve(schur, np.einsum("hgs,hs->g", C, solved[..., -1]) - normal.a)
    own = -solved[..., -1] - solved[..., :-1] @ change
    moves = change[: 6 * views].reshape(views, 6)
    return _State(
        rigid(rotation_from_axis_angle(moves[:, :3]), moves[:, 3:]) @ state.T,
        state.points + own.reshape(state.points.shape),
        state.log_bones + change[6 * views :].reshape(state.log_bones.shape),
    )


def _add_pixels(normal: _Normal, problem: _Problem, state: _State, pixels: Array) -> None:
    """Add what the key points say of the cameras and of the joints."""
    views, joints = problem.seen.shape[1:]
    weight = _weight(pixels**2, axis=-1) * problem.seen
    J_cam, J_point = _pixel_jacobians(problem, state)
    W_cam = weight[..., None, None] * J_cam
    of_cam = np.einsum("hvjri,hvjrk->vik", W_cam, J_cam, optimize=True)
    gradient = np.einsum("hvjri,hvjr->vi", W_cam, pixels, optimize=True)
    mixed = np.einsum("hvjri,hvjrk->hvijk", W_cam, J_point, optimize=True)
    for view in range(views):
        part = slice(6 * view, 6 * view + 6)
        normal.A[part, part] += of_cam[view]
        normal.a[part] += gradient[view]
        normal.C[:, part] += mixed[:, view]
    W_point = weight[..., None, None] * J_point
    of_point = np.einsum("hvjri,hvjrk->jhik", W_point, J_point, optimize=True)
    normal.B[:, np.arange(joints), :, np.arange(joints)] += of_point
    normal.b[:] += np.einsum("hvjri,hvjr->hji", W_point, pixels, optimize=True)


def _add_bones(normal: _Normal, problem: _Problem, state: _State, bones: Array) -> None:
    """Add that every bone is as long in one frame as in all of its hand."""
    hands, views, _ = problem.seen.shape
    every = np.arange(hands)
    for bone, (a, b) in enumerate(problem.bones):
        weight = _weight(bones[:, [bone]] ** 2, axis=-1) * (problem.known[:, a] & problem.known[:, b])
        along = state.points[:, a] - state.points[:, b]
        slope = along / np.maximum((along**2).sum(-1, keepdims=True), 1e-18) / _BONE_SHARE
        W_slope = weight[:, None] * slope
        for sign, joint in ((1, a), (-1, b)):
            normal.b[:, joint] += sign * bones[:, [bone]] * W_slope
            normal.B[:, joint, :, joint] += W_slope[:, :, None] * slope[:, None]
            normal.B[:, joint, :, a + b - joint] -= W_slope[:, :, None] * slope[:, None]
        column = 6 * views + problem.group * len(problem.bones) + bone
        np.add.at(normal.A, (column, column), weight / _BONE_SHARE**2)
        np.add.at(normal.a, column, -weight * bones[:, bone] / _BONE_SHARE)
        normal.C[every, column, a] -= W_slope / _BONE_SHARE
        normal.C[every, column, b] += W_slope / _BONE_SHARE


def _weight(squares: Array, axis: int) -> Array:
    """Return the weight of residuals whose tails are those of `_cost`."""
    return 1.5 / (1 + squares.sum(axis) / 2)


def _pixel_jacobians(problem: _Problem, state: _State) -> tuple[Array, Array]:
    """Return d pixel / d camera (hand, view, joint, 2, 6) and d pixel / d joint (.., 2, 3), weighed."""
    cam = transform_points(state.T, state.points[:, None])
    z = np.where(cam[..., 2] > 1e-6, cam[..., 2], 1.0)
    K = problem.K[None, :, None, :2, :2] / problem.sigma_px
    x, y, zero = cam[..., 0] / z, cam[..., 1] / z, np.zeros_like(z)
    of_cam = np.stack([np.stack([1 / z, zero, -x / z], -1), np.stack([zero, 1 / z, -y / z], -1)], -2)
    of_cam = K @ of_cam
    J_cam = np.concatenate([-of_cam @ skew_matrix(cam), of_cam], -1)
    return J_cam, of_cam @ state.T[None, :, None, :3, :3]


def _project(K: Array, T: Array, points: Array) -> tuple[Array, Array]:
    cam = transform_points(T, points[:, None])
    z = np.where(cam[..., 2:] > 1e-6, cam[..., 2:], 1.0)
    uv = np.einsum("vij,hvpj->hvpi", K[:, :2, :2], cam[..., :2] / z) + K[:, None, :2, 2]
    return uv, cam[..., 2]


def _noise_px(problem: _Problem, state: _State) -> float:
    """Return the standard deviation of a coordinate, from the median distance of the key points."""
    uv, depth = _project(problem.K, state.T, state.points)
    distance = np.linalg.norm(uv - problem.ideal_px, axis=-1)[problem.seen & (depth > 0)]
    return max(float(np.median(distance)) / 1.18, 0.05) if distance.size else 1.0


def _bone_lengths(problem: _Problem, points: Array) -> Float[Array, "group bone"]:
    a, b = problem.bones.T
    length = np.log(np.maximum(np.linalg.norm(points[:, a] - points[:, b], axis=-1), 1e-9))
    length = np.where(problem.known[:, a] & problem.known[:, b], length, np.nan)
    found = np.zeros((int(problem.group.max()) + 1, len(a)))
    for group in range(len(found)):
        own = length[problem.group == group]
        known = np.isfinite(own).any(0)
        found[group, known] = np.nanmedian(own[:, known], 0)
    return found


def _hold() -> Float[Array, "6"]:
    return np.repeat(_HOLD, 3)
