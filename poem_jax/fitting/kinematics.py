"""The 21 key points of a hand and their exact derivative, without the other vertices.

Every key point is a linear-blend point: a skeleton joint follows its parent alone, a finger tip is a vertex
with its skin weights and pose correction. With the wrist pinned at the origin, key point p is

    X_p = B_p r_p + sum_a W_pa (G_parent(a) - G_a) J_a,   B_p = sum_k w_pk G_k,
    W_pa = sum_{k in or below a} w_pk,

linear in the shaped rest positions r (key points) and J (skeleton); G_k = world rotation of joint k. A turn
by the small world vector dw of joint j moves X_p by dw x c_pj, c_pj = sum_{k in or below j} w_pk (X_pk -
P_j), X_pk where joint k alone would carry p, P_j the joint's place. An axis-angle vector theta of joint j
turns by dw = G_parent(j) Jl(theta) dtheta, Jl the left Jacobian of SO(3) (Sola et al. 2018, eq. 145).

A detector may see key points at other places than the joints of the hand (`detector_offsets`): its offsets o
join the rest positions of the key points, r_p + o_p, and leave the skeleton alone.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from poem_jax.fitting.detector_offsets import KeypointOffsets, rest_offsets
from poem_jax.geometry.transforms import matmul, rotation_from_axis_angle, skew_matrix
from poem_jax.hand.joint_limits import POSE_LIMITS, anatomical_axes
from poem_jax.hand.model import HandModel, forward_kinematics, layer_tips
from poem_jax.hand.topology import (
    MANO_PARENTS,
    NUM_FINGERS,
    NUM_JOINTS,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    OPENPOSE_FROM_MANO,
    SKELETON_FROM_OPENPOSE,
)
from poem_jax.typing import Array, Float

POSE_SIZE = 3 * NUM_SKELETON_JOINTS
STATE_SIZE = POSE_SIZE + 3
"""Pose (the wrist's turn as a small world vector, the fingers' axis-angle) and the wrist's place."""

_SKELETON = np.array(SKELETON_FROM_OPENPOSE, np.int32)
_TIPS = np.array([OPENPOSE_FROM_MANO.index(NUM_SKELETON_JOINTS + f) for f in range(NUM_FINGERS)], np.int32)
_PARENTS = np.array(MANO_PARENTS[1:], np.int32)
_SMALL_ANGLE_SQUARED = 1e-4


def _ancestors() -> np.ndarray:
    """Return (k, a): 1 where joint a is k or lies between k and the wrist."""
    table = np.eye(NUM_SKELETON_JOINTS, dtype=np.float32)
    for k in range(1, NUM_SKELETON_JOINTS):
        table[k] += table[MANO_PARENTS[k]]
    return table


_ANCESTORS = _ancestors()


class KeypointModel(NamedTuple):
    """What of a hand moves its 21 key points, with the limits of its joints."""

    hand: HandModel
    skeleton: Float[Array, "16 3"]
    """Rest skeleton of the mean shape, metres."""
    skeleton_directions: Float[Array, "16 3 10"]
    points: Float[Array, "21 3"]
    """Rest key points of the mean shape, OpenPose order, metres."""
    point_directions: Float[Array, "21 3 10"]
    weights: Float[Array, "21 16"]
    """Which joints carry a key point."""
    correctives: Float[Array, "5 3 135"]
    """Pose correction of the tips, thumb to little."""
    axes: Float[Array, "15 3 3"]
    """Anatomical axes: rows flexion, abduction, twist."""
    limits: Float[Array, "15 3 2"]
    """(lowest, highest) of the anatomical angles, radians."""
    offsets: Float[Array, "21 3"] | None = None
    """From the rest key points to where a detector sees them, metres; None = it sees them there."""


class PosedKeypoints(NamedTuple):
    """Key points of a pose, wrist at the origin, and what their derivatives need."""

    points: Float[Array, "*batch 21 3"]
    """As a detector sees them: moved by the model's offsets, if it has any."""
    rotations: Float[Array, "*batch 16 3 3"]
    """World rotation of every joint."""
    local: Float[Array, "*batch 16 3 3"]
    blended: Float[Array, "*batch 21 3 3"]
    """B_p."""
    skeleton: Float[Array, "*batch 16 3"]
    """Shaped skeleton at rest, wrist at the origin."""
    rest: Float[Array, "*batch 21 3"]
    """Shaped key points at rest with their pose correction, and the offsets if there are any."""


def keypoint_model(hand: HandModel, detector: KeypointOffsets | None = None) -> KeypointModel:
    """Reduce a concrete hand to what its key points need; call it once, outside `jax.jit`.

    Two hands' models may be stacked leaf by leaf and mapped over.

    Args:
        hand: of either side.
        detector: where the detector of the key points sees them (`detector_offsets.DETECTORS`); None takes
            them to be the hand's own joints and tips. What a fit returns are those in either case.
    """
    hand = HandModel(*(np.asarray(array) for array in hand))
    tips = layer_tips(hand)
    skeleton = hand.J_regressor @ hand.v_template
    directions = np.einsum("jv,vcs->jcs", hand.J_regressor, hand.shapedirs)
    order = np.array(OPENPOSE_FROM_MANO)
    followed = np.eye(NUM_SKELETON_JOINTS, dtype=skeleton.dtype)[[0, *_PARENTS]]
    return KeypointModel(
        hand=hand,
        skeleton=skeleton,
        skeleton_directions=directions,
        points=np.concatenate([skeleton, hand.v_template[tips]])[order],
        point_directions=np.concatenate([directions, hand.shapedirs[tips]])[order],
        weights=np.concatenate([followed, hand.weights[tips]])[order],
        correctives=hand.posedirs[tips],
        axes=anatomical_axes(hand).astype(skeleton.dtype),
        limits=POSE_LIMITS.astype(skeleton.dtype),
        offsets=None if detector is None else rest_offsets(hand, detector).astype(skeleton.dtype),
    )


def pose_keypoints(
    model: KeypointModel, pose: Float[Array, "*batch 16 3"], shape: Float[Array, "*batch 10"]
) -> PosedKeypoints:
    """Return the 21 key points of axis-angle `pose`, wrist at the origin; see `PosedKeypoints`."""
    return pose_keypoints_of_rotations(model, rotation_from_axis_angle(pose), shape)


def pose_keypoints_of_rotations(
    model: KeypointModel, local: Float[Array, "*batch 16 3 3"], shape: Float[Array, "*batch 10"]
) -> PosedKeypoints:
    """Return the 21 key points for rotations relative to the parent joints, wrist at the origin."""
    local, shape = jnp.asarray(local), jnp.asarray(shape)
    skeleton = model.skeleton + _directions(model.skeleton_directions, shape)
    wrist = skeleton[..., :1, :]
    skeleton = skeleton - wrist
    rest = model.points + _directions(model.point_directions, shape) - wrist
    if model.offsets is not None:
        rest = rest + model.offsets
    batch = local.shape[:-3]
    features = (local[..., 1:, :, :] - jnp.eye(3, dtype=local.dtype)).reshape(*batch, -1)
    correction = matmul(features, model.correctives.reshape(3 * NUM_FINGERS, -1).T)
    rest = rest.at[..., _TIPS, :].add(correction.reshape(*batch, NUM_FINGERS, 3))
    rotations, _ = forward_kinematics(local, skeleton)
    blended = _mix(model.weights, rotations)
    points = _rotate(blended, rest) + matmul(_carried(model), _rotate(_bends(rotations), skeleton))
    return PosedKeypoints(points, rotations, local, blended, skeleton, rest)


def pose_jacobian(
    model: KeypointModel, posed: PosedKeypoints, pose: Float[Array, "*batch 16 3"]
) -> Float[Array, "*batch 21 3 48"]:
    """Return d X / d (wrist's small world turn, fingers' axis-angle vectors)."""
    lever = _levers(model, posed)
    per_turn = -skew_matrix(lever)
    turn = _left_jacobian(pose[..., 1:, :])
    world = _product(posed.rotations[..., _PARENTS, :, :], turn)
    fingers = _product(per_turn[..., 1:, :, :], world[..., None, :, :, :])
    fingers = fingers.at[..., _TIPS, :, :, :].add(_corrective_jacobian(model, posed, turn))
    jacobian = jnp.concatenate([per_turn[..., :1, :, :], fingers], axis=-3)
    return jnp.moveaxis(jacobian, -3, -2).reshape(*pose.shape[:-2], NUM_JOINTS, 3, POSE_SIZE)


def shape_jacobian(model: KeypointModel, posed: PosedKeypoints) -> Float[Array, "*batch 21 3 10"]:
    """Return d X / d shape, wrist at the origin."""
    batch = posed.points.shape[:-2]
    pinned = model.skeleton_directions - model.skeleton_directions[:1]
    points = model.point_directions - model.skeleton_directions[:1]
    bent = jnp.sum(_bends(posed.rotations)[..., None] * pinned[:, None], axis=-2)
    moved = matmul(_carried(model), bent.reshape(*batch, NUM_SKELETON_JOINTS, -1))
    own = jnp.sum(posed.blended[..., None] * points[:, None], axis=-2)
    return own + moved.reshape(*batch, NUM_JOINTS, 3, NUM_SHAPES)


def joints_of(model: KeypointModel, posed: PosedKeypoints) -> Float[Array, "*batch 21 3"]:
    """Return the hand's own joints and tips of a pose, wrist at the origin: the key points less offsets."""
    if model.offsets is None:
        return posed.points
    return posed.points - _rotate(posed.blended, model.offsets)


def rest_wrist(model: KeypointModel, shape: Float[Array, "*batch 10"]) -> Float[Array, "*batch 3"]:
    """Return where the shaped template has its wrist: `translation` = wrist's place - this."""
    return model.skeleton[0] + _directions(model.skeleton_directions[:1], shape)[..., 0, :]


def _carried(model: KeypointModel) -> Float[Array, "21 16"]:
    """Return W_pa, how much of key point p is carried by joint a and those below it."""
    return matmul(model.weights, _ANCESTORS)


def _levers(model: KeypointModel, posed: PosedKeypoints) -> Float[Array, "*batch 21 16 3"]:
    """Return c_pj = sum_{k in or below j} w_pk (X_pk - P_j)."""
    batch = posed.points.shape[:-2]
    joints = joints_of(model, posed)[..., _SKELETON, :]
    offset = joints - _rotate(posed.rotations, posed.skeleton)
    carriers = jnp.concatenate([posed.rotations.reshape(*batch, NUM_SKELETON_JOINTS, 9), offset], axis=-1)
    split = (model.weights[:, None, :] * _ANCESTORS.T).reshape(-1, NUM_SKELETON_JOINTS)
    mixed = matmul(split, carriers)
    mixed = mixed.reshape(*batch, NUM_JOINTS, NUM_SKELETON_JOINTS, 12)
    turns = mixed[..., :9].reshape(*mixed.shape[:-1], 3, 3)
    below = _carried(model)[..., None]
    return _rotate(turns, posed.rest[..., :, None, :]) + mixed[..., 9:] - below * joints[..., None, :, :]


def _corrective_jacobian(
    model: KeypointModel, posed: PosedKeypoints, turn: Float[Array, "*batch 15 3 3"]
) -> Float[Array, "*batch 5 15 3 3"]:
    """Return the derivative of the tips' pose correction by the fingers' axis-angle vectors."""
    # d R = [Jl dtheta]x R: column c of `turn` gives the matrix [Jl e_c]x R.
    local = posed.local[..., 1:, :, :]
    change = _product(skew_matrix(jnp.swapaxes(turn, -1, -2)), local[..., None, :, :])
    change = jnp.swapaxes(change.reshape(*change.shape[:-2], 9), -1, -2)
    directions = jnp.moveaxis(model.correctives.reshape(3 * NUM_FINGERS, -1, 9), 0, 1)
    moved = matmul(directions, change)
    moved = moved.reshape(*moved.shape[:-2], NUM_FINGERS, 3, 3)
    return _product(posed.blended[..., _TIPS, None, :, :], jnp.swapaxes(moved, -4, -3))


def _left_jacobian(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Return Jl = I + (1 - cos a)/a^2 [v]x + (a - sin a)/a^3 [v]x^2, a = |v|."""
    a2 = jnp.sum(v * v, axis=-1)
    small = a2 < _SMALL_ANGLE_SQUARED
    safe = jnp.where(small, 1, a2)
    a = jnp.sqrt(safe)
    first = jnp.where(small, 0.5 - a2 / 24, 2 * jnp.sin(a / 2) ** 2 / safe)[..., None, None]
    second = jnp.where(small, 1 / 6 - a2 / 120, (a - jnp.sin(a)) / (a * safe))[..., None, None]
    eye = jnp.eye(3, dtype=v.dtype)
    square = v[..., :, None] * v[..., None, :] - a2[..., None, None] * eye
    return eye + first * skew_matrix(v) + second * square


def _directions(directions: Array, shape: Array) -> Array:
    """Return sum_s directions[..., s] shape_s."""
    flat = directions.reshape(-1, NUM_SHAPES)
    moved = matmul(shape, flat.T)
    return moved.reshape(*shape.shape[:-1], *directions.shape[:-1])


def _bends(rotations: Float[Array, "*batch 16 3 3"]) -> Float[Array, "*batch 16 3 3"]:
    """Return G_parent(a) - G_a; zero for the wrist."""
    bends = rotations[..., _PARENTS, :, :] - rotations[..., 1:, :, :]
    return jnp.concatenate([jnp.zeros_like(bends[..., :1, :, :]), bends], axis=-3)


def _mix(weights: Array, rotations: Array) -> Array:
    flat = rotations.reshape(*rotations.shape[:-2], 9)
    mixed = matmul(weights, flat)
    return mixed.reshape(*mixed.shape[:-1], 3, 3)


def _rotate(matrices: Array, vectors: Array) -> Array:
    """Multiply (..., 3, 3) by (..., 3) as a plain sum, which XLA fuses."""
    return jnp.sum(matrices * vectors[..., None, :], axis=-1)


def _product(a: Array, b: Array) -> Array:
    """Multiply (..., 3, 3) matrices as a plain sum, which XLA fuses."""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)
