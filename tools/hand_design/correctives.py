"""Pose corrections: what linear blend skinning loses at a bend is put back (MANO's axes, metres).

Linear blending pulls vertices near a joint towards it. A joint that turns alone should carry them on an
arc: with s = the share of a vertex that follows the joint, about the joint by the rotation part-way, as
dual quaternions would (Kavan et al. 2007). The displacement at rest that makes linear skinning land there
is fitted, per joint, as a linear function of the nine entries of R - I, which is what MANO's schema holds.
On the inner side of a bend, vertices are also kept on their own side of the plane that halves it, where
flesh would meet flesh.
"""

import numpy as np
from hand_design.skin import MANO_FINGERS, NUM_BONES, first_bone

from poem_jax.geometry.transforms import rotation_from_axis_angle

_FLEXION = (-0.35, 1.75)
_ABDUCTION, _TWIST = 0.5, 0.4
_SAMPLES = 150
_RIDGE = 3e-1
_ON_JOINT_M, _MARGIN_M, _MAX_M = 0.0005, 0.0010, 0.010
_BOOSTS = 8


def following_share(weights: np.ndarray, joint: int) -> np.ndarray:
    """Sum of the weights of a joint and of all beyond it on its finger."""
    last = joint + 2 - (joint - 1) % 3
    return weights[:, joint : last + 1].sum(axis=1)


def _turned(share: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotations part-way along each axis-angle vector: normalised quaternion blend, (samples, 778, 3, 3)."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    half = angle / 2
    partial = 2 * np.arctan2(share * np.sin(half), 1 - share + share * np.cos(half))
    return rotation_from_axis_angle((vectors / angle)[:, None] * partial[..., None])


def _samples(axes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    low = np.array([_FLEXION[0], -_ABDUCTION, -_TWIST])
    high = np.array([_FLEXION[1], _ABDUCTION, _TWIST])
    return rng.uniform(low, high, (_SAMPLES, 3)) @ axes


def _claim(weights: np.ndarray, joint: int) -> np.ndarray:
    """How far a vertex is this finger's business, so that the corrections of neighbours do not add up."""
    if joint == first_bone("thumb"):
        return np.zeros(len(weights))
    fingers = weights[:, 1:].reshape(len(weights), -1, 3).sum(axis=2)
    finger = (joint - 1) // 3
    return fingers[:, finger] / np.maximum(fingers.sum(axis=1), 1e-9)


class _Bend:
    """One joint turning alone in several ways, seen from its centre."""

    def __init__(
        self, arm: np.ndarray, share: np.ndarray, vectors: np.ndarray, bone: np.ndarray, claim: np.ndarray
    ):
        full = rotation_from_axis_angle(vectors)
        self.arm, self.claim = arm, claim
        self.blended = (1 - share)[:, None, None] * np.eye(3) + share[:, None, None] * full[:, None]
        self.arcs = (_turned(share, vectors) @ arm[..., None])[..., 0]
        self.features = (full - np.eye(3)).reshape(len(vectors), 9)
        normal = bone + full @ bone
        self.normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        along = arm @ bone
        self.side = np.where(np.abs(along) < _ON_JOINT_M, 0.0, np.sign(along))

    def fitted(self, strength: float) -> np.ndarray:
        """Return (9, n * 3): rest displacements linear in R - I that keep to arcs and sides."""
        plain = (self.blended @ self.arm[..., None])[..., 0]
        goal = self._kept_apart(plain + strength * (self.arcs - plain))
        gram = self.features.T @ self.features + _RIDGE * np.eye(9)
        fit = np.zeros((9, self.arm.size))
        offsets = self._at_rest(goal)
        for _ in range(_BOOSTS):
            fit = np.linalg.solve(gram, self.features.T @ offsets.reshape(len(offsets), -1))
            reached = self.arm + (self.features @ fit).reshape(offsets.shape)
            posed = (self.blended @ reached[..., None])[..., 0]
            offsets = offsets + self._at_rest(self._kept_apart(posed)) - self._at_rest(posed)
        return fit

    def _kept_apart(self, posed: np.ndarray) -> np.ndarray:
        """Push vertices back to their own side of the plane that halves the bend: there flesh meets flesh."""
        height = self.side * (posed * self.normal[:, None]).sum(-1)
        lack = np.where(self.side == 0, 0.0, np.maximum(_MARGIN_M - height, 0.0))
        lack = self.claim * np.minimum(lack, _MAX_M)
        return posed + (self.side * lack)[..., None] * self.normal[:, None]

    def _at_rest(self, posed: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self.blended, posed[..., None])[..., 0] - self.arm


def pose_directions(
    v: np.ndarray, weights: np.ndarray, joints: np.ndarray, axes: np.ndarray, strength: float
) -> np.ndarray:
    """(778, 3, 135).

    Args:
        v: rest vertices.
        weights: skin weights.
        joints: (16, 3) joints at rest.
        axes: (15, 3, 3) flexion, abduction and twist axes of each bending joint, unit rows.
        strength: 0 = plain linear skinning, 1 = full arcs.
    """
    rng = np.random.default_rng(0)
    directions = np.zeros((len(v), 3, NUM_BONES - 1, 9))
    for name in MANO_FINGERS:
        for j in range(first_bone(name), first_bone(name) + 3):
            share = following_share(weights, j)
            near = np.flatnonzero((share > 1e-3) & (share < 1 - 1e-3))
            vectors = _samples(axes[j - 1], rng)
            bend = _Bend(v[near] - joints[j], share[near], vectors, axes[j - 1, 2], _claim(weights, j)[near])
            fit = bend.fitted(strength)
            directions[near, :, j - 1] = fit.reshape(9, len(near), 3).transpose(1, 2, 0)
    return directions.reshape(len(v), 3, -1)
