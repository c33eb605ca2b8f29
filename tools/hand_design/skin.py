"""Skin weights and joint regressor.

Weights: every vertex first belongs to one bone, cut squarely across each joint; then the labels diffuse
over the surface (implicit heat step with the cotangent Laplacian), narrowly on the fingers and widely in
the palm. Rows stay non-negative and sum to 1. Bones are numbered as MANO's skeleton joints.
"""

import numpy as np
from hand_design.anatomy import FINGERS, SKELETON
from hand_design.mesh import Mesh
from scipy.optimize import nnls

MANO_FINGERS = ("index", "middle", "little", "ring", "thumb")
NUM_BONES = 16
_FINGER_WIDTH_MM = 3.4
_PALM_WIDTH_MM = 7.0
_MAX_BONES = 4
_TIE_DIGITS = 9
"""Distances in mm that agree to so many digits count as equal, whatever rounding made of them."""


def first_bone(name: str) -> int:
    """Number of the first bone of a finger."""
    return 3 * MANO_FINGERS.index(name) + 1


def skeleton() -> np.ndarray:
    """Design positions of the 16 joints, (16, 3) mm."""
    return np.vstack([np.zeros((1, 3))] + [SKELETON[name].joints[:3] for name in MANO_FINGERS])


def _finger_labels(mesh: Mesh, labels: np.ndarray) -> None:
    for name in FINGERS:
        bone = first_bone(name)
        for ring, station in zip(mesh.rings[name][1:], mesh.stations[name], strict=True):
            labels[ring] = 0.0
            low = min(int(np.floor(station)), 2)
            if np.isclose(station, np.round(station)):
                labels[ring, bone + low] = labels[ring, bone + low - 1] = 0.5
            else:
                labels[ring, bone + low] = 1.0
        labels[mesh.tips[name]] = 0.0
        labels[mesh.tips[name], bone + 2] = 1.0


def _palm_labels(v: np.ndarray) -> np.ndarray:
    """Wrist, or the finger (metacarpal of the thumb) that a vertex of the palm follows."""
    labels = np.zeros((len(v), NUM_BONES))
    labels[:, 0] = 1.0
    names = FINGERS[1:]
    ahead, aside = [], []
    for name in names:
        root, next_joint = SKELETON[name].joints[:2]
        axis = (next_joint - root) / np.linalg.norm(next_joint - root)
        offset = v - root
        ahead.append(offset @ axis)
        aside.append(np.linalg.norm((offset - ahead[-1][:, None] * axis)[:, :2], axis=1))
    nearest = np.argmin(aside, axis=0)
    for k, name in enumerate(names):
        mine = (nearest == k) & (ahead[k] > 0)
        labels[mine] = np.eye(NUM_BONES)[first_bone(name)]
    cmc, mcp = SKELETON["thumb"].joints[:2]
    t = np.clip((v - cmc) @ (mcp - cmc) / ((mcp - cmc) @ (mcp - cmc)), 0.0, 1.0)
    near = np.linalg.norm(v - cmc - t[:, None] * (mcp - cmc), axis=1)
    axis = (mcp - cmc) / np.linalg.norm(mcp - cmc)
    thumb = (near < 19.0) & ((v - cmc) @ axis > 6.0) & (nearest_free(labels, v))
    labels[thumb] = np.eye(NUM_BONES)[first_bone("thumb")]
    return labels


def nearest_free(labels: np.ndarray, v: np.ndarray) -> np.ndarray:
    """True where no finger has claimed the vertex and it lies towards the thumb."""
    return (labels[:, 0] == 1.0) & (v[:, 1] > 14.0)


def cotangent_laplacian(v: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (L positive semi-definite, vertex areas); negative cotangents are raised to a small value."""
    n = len(v)
    lap, area = np.zeros((n, n)), np.zeros(n)
    for k in range(3):
        i, j, o = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        a, b = v[i] - v[o], v[j] - v[o]
        double = np.linalg.norm(np.cross(a, b), axis=1)
        weight = np.maximum(0.5 * (a * b).sum(1) / double, 0.05)
        np.add.at(lap, (i, j), -weight)
        np.add.at(lap, (j, i), -weight)
        np.add.at(area, o, double / 6)
    np.fill_diagonal(lap, -lap.sum(axis=1))
    return lap, area


def _diffused(mesh: Mesh, labels: np.ndarray, width: np.ndarray) -> np.ndarray:
    lap, area = cotangent_laplacian(mesh.vertices, mesh.faces)
    heat = np.eye(len(area)) + (width**2 / area)[:, None] * lap
    return np.linalg.solve(heat, labels)


def skin_weights(mesh: Mesh, spread: float = 1.0) -> np.ndarray:
    """(778, 16); `spread` widens the transitions (the shape directions want broader ones)."""
    labels = _palm_labels(mesh.vertices)
    _finger_labels(mesh, labels)
    width = np.full(len(mesh.vertices), _PALM_WIDTH_MM)
    for name in FINGERS:
        width[mesh.rings[name][1:]] = _FINGER_WIDTH_MM
        width[mesh.tips[name]] = _FINGER_WIDTH_MM
    weights = _diffused(mesh, labels, spread * width)
    if spread != 1.0:
        return weights
    smallest_kept = np.sort(weights, axis=1)[:, -_MAX_BONES][:, None]
    weights = np.where((weights >= smallest_kept) & (weights > 1e-3), weights, 0.0)
    return weights / weights.sum(axis=1, keepdims=True)


def _nearest_first(gap: np.ndarray) -> np.ndarray:
    """Order vertices by distance; of equally near ones the last comes first, on every machine."""
    return np.lexsort((-np.arange(len(gap)), np.round(gap, _TIE_DIGITS)))


def joint_regressor(v: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """(16, 778), non-negative: vertices near each joint, weighted so that they average to it exactly."""
    regressor = np.zeros((len(joints), len(v)))
    for j, joint in enumerate(joints):
        gap = np.linalg.norm(v - joint, axis=1)
        near = _nearest_first(gap)[:32]
        scale = gap[near].mean()
        prior = np.exp(-0.5 * (gap[near] / (0.8 * scale)) ** 2)
        prior /= prior.sum()
        strong = 1e3
        rows = np.vstack(
            [strong * (v[near] - joint).T / scale, strong * np.ones(len(near)), np.eye(len(near))]
        )
        goal = np.concatenate([np.zeros(3), [strong], prior])
        regressor[j, near] = nnls(rows, goal)[0]
    return regressor / regressor.sum(axis=1, keepdims=True)
