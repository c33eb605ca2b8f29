"""A quick test whether fingers run into each other: capsules along the bones instead of the mesh.

Letters: a finger is the polyline p_0 .. p_3 (first joint to tip); a capsule is one of its three segments
with a radius. Metres, the frame of the resting shipped hand, fingers in MANO's order.
"""

from functools import cache

import numpy as np

from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.joint_limits import resting_fingers
from poem_jax.hand.model import forward_kinematics
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import MANO_FINGER_NAMES
from poem_jax.typing import Array, Float

_THUMB = MANO_FINGER_NAMES.index("thumb")
_RADII_MM = {
    "index": (9.4, 8.8, 7.8),
    "middle": (9.5, 9.0, 8.0),
    "ring": (8.9, 8.4, 7.5),
    "little": (7.9, 7.5, 6.7),
    "thumb": (11.0, 10.4, 9.8),
}
_PALM_RADIUS_MM = 12.5
_SPARE = 1.1
"""Capsules are a little wider than the mean hand, for hands with thicker fingers."""
_SEGMENT_RADII = np.array([_RADII_MM[name] for name in MANO_FINGER_NAMES]) * (1e-3 * _SPARE)


@cache
def _rest_fingers() -> np.ndarray:
    return resting_fingers(default_hand())


@cache
def _rest_skeleton() -> np.ndarray:
    hand = default_hand()
    return hand.J_regressor.astype(float) @ hand.v_template.astype(float)


def posed_fingers(pose: Float[Array, "n 16 3"]) -> Float[np.ndarray, "n 5 4 3"]:
    """Bend the shipped skeleton: joints and tip of every finger, metres."""
    skeleton = _rest_skeleton()
    turns, joints = forward_kinematics(rotation_from_axis_angle(pose), skeleton)
    last = slice(3, None, 3)
    tips = joints[:, last] + (turns[:, last] * (_rest_fingers()[:, -1] - skeleton[last])[:, None, :]).sum(-1)
    return np.concatenate([joints[:, 1:].reshape(-1, 5, 3, 3), tips[:, :, None]], axis=2)


def smallest_gap(fingers: Float[np.ndarray, "n 5 4 3"]) -> Float[np.ndarray, " n"]:
    """Return the smallest gap between capsules that should not touch, metres; negative = they overlap."""
    first, second, allowed = _pairs()
    starts, ends = _segments(fingers)
    gap = segment_distance(starts[:, first], ends[:, first], starts[:, second], ends[:, second])
    return (gap - allowed).min(axis=1)


def _segments(fingers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 15 finger segments and then 4 of the palm, (n, 19, 3) starts and ends."""
    n = len(fingers)
    palm_start, palm_end = (np.broadcast_to(end, (n, *end.shape)) for end in _palm_segments())
    starts = np.concatenate([fingers[:, :, :-1].reshape(n, 15, 3), palm_start], axis=1)
    ends = np.concatenate([fingers[:, :, 1:].reshape(n, 15, 3), palm_end], axis=1)
    return starts, ends


@cache
def _palm_segments() -> tuple[np.ndarray, np.ndarray]:
    wrist, roots = _rest_skeleton()[0], _rest_fingers()[np.arange(5) != _THUMB, 0]
    return wrist + 0.35 * (roots - wrist), wrist + 0.9 * (roots - wrist)


@cache
def _pairs() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs of segments to keep apart and the sum of their radii."""
    radii = np.concatenate([_SEGMENT_RADII.ravel(), np.full(4, _PALM_RADIUS_MM * 1e-3)])
    pairs = [(a, b) for a in range(19) for b in range(a + 1, 19) if _must_clear(a, b)]
    first, second = np.array(pairs).T
    return first, second, radii[first] + radii[second]


def _must_clear(a: int, b: int) -> bool:
    """Leave out what is joined: neighbours of one finger, roots of fingers, the thumb's root in the palm."""
    finger_a, segment_a = divmod(a, 3)
    if b >= 15:
        return a < 15 and segment_a > 0
    finger_b, segment_b = divmod(b, 3)
    if finger_a == finger_b:
        return segment_b - segment_a == 2 and finger_a != _THUMB
    roots = (segment_a == 0 and finger_a == _THUMB) or (segment_b == 0 and finger_b == _THUMB)
    return not roots


def segment_distance(
    p1: Float[np.ndarray, "*batch 3"],
    q1: Float[np.ndarray, "*batch 3"],
    p2: Float[np.ndarray, "*batch 3"],
    q2: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch"]:
    """Distance between segments p1-q1 and p2-q2 of positive length (Ericson 2005, section 5.1.9)."""
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e, b = (d1 * d1).sum(-1), (d2 * d2).sum(-1), (d1 * d2).sum(-1)
    c, f = (d1 * r).sum(-1), (d2 * r).sum(-1)
    s = np.clip((b * f - c * e) / np.maximum(a * e - b * b, 1e-12 * a * e), 0.0, 1.0)
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / a, 0.0, 1.0)
    return np.linalg.norm(r + s[..., None] * d1 - t[..., None] * d2, axis=-1)
