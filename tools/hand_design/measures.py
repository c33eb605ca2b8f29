"""What is measured on the shipped hand: sizes, volume, self-intersection. Needs only the package.

Published sizes, millimetres, means over both sexes of adults:

- segments: Buryanov & Kotiuk, "Proportions of hand segments", Int. J. Morphol. 28(3), 2010 (bones; the end
  segments with the soft tissue beyond the bone);
- wrist joint to knuckles: coefficients of Buchholz, Armstrong & Goldstein, Ergonomics 35(3), 1992 (the wrist
  turns about the head of the capitate), times the hand length below; for the middle finger also metacarpal
  (Buryanov & Kotiuk) plus carpal height, 0.54 metacarpals (Youm et al., J. Bone Joint Surg. 60A, 1978: from
  the end of the radius). The true joint moves between the two, so they differ by 20 %;
- hand length, breadths and thicknesses: Pheasant & Haslegrave, "Bodyspace", 3rd ed., table of the hand
  (British adults); the breadths of the middle, ring and little finger after Garrett, Human Factors 13(2),
  1971, rounded.

The numbers were written down from these works without the print at hand (the bones were found the same in a
second place): look them up before quoting them. Breadths at the end joints, of the palm at the wrist and
of the forearm are compared with nothing.
"""

import numba
import numpy as np

from poem_jax.hand import HandModel, hand_mesh
from poem_jax.hand.topology import BONES, FINGER_NAMES, JOINT_NAMES, SKELETON_JOINT_NAMES

SEGMENTS_MM = {
    "thumb": (46.2, 31.6, 27.4),
    "index": (39.8, 22.4, 19.7),
    "middle": (44.6, 26.3, 21.4),
    "ring": (41.4, 25.7, 21.3),
    "little": (32.7, 18.1, 19.7),
}
BREADTHS_MM = {"thumb_ip": 21.0, "index_pip": 19.5, "middle_pip": 19.5, "ring_pip": 18.5, "little_pip": 16.5}
DEPTHS_MM = {"thumb_ip": 20.0, "index_pip": 17.5}
_COEFFICIENTS = {"thumb": 0.118, "index": 0.463, "middle": 0.446, "ring": 0.421, "little": 0.414}
HAND_MM = {"length": 181.5, "breadth": 81.5, "thickness": 30.5}
WRIST_TO_KNUCKLE_MM = {name: share * HAND_MM["length"] for name, share in _COEFFICIENTS.items()}
"""From the wrist joint to the first joint of each finger; the thumb's is its carpometacarpal joint."""
RADIUS_TO_MIDDLE_KNUCKLE_MM = 64.6 * (1 + 0.54)


def resting(model: HandModel):
    """Mesh of the mean shape at rest."""
    return hand_mesh(model, np.zeros((16, 3)), np.zeros(10))


def segment_lengths_mm(model: HandModel) -> dict[str, tuple[float, ...]]:
    """Three lengths per finger between key points, the last to the tip vertex."""
    joints = resting(model).joints
    lengths = np.array([np.linalg.norm(joints[b] - joints[a]) for a, b in BONES]) * 1e3
    return {name: tuple(lengths[4 * f + 1 : 4 * f + 4]) for f, name in enumerate(FINGER_NAMES)}


def wrist_to_knuckle_mm(model: HandModel) -> dict[str, float]:
    """From the wrist joint to the first joint of each finger."""
    joints = resting(model).joints * 1e3
    return {name: float(np.linalg.norm(joints[4 * f + 1] - joints[0])) for f, name in enumerate(FINGER_NAMES)}


def girth_mm(model: HandModel, joint_name: str, axes: np.ndarray) -> tuple[float, float]:
    """Breadth and depth of a finger in the plane through one of its joints, square to the bone.

    Args:
        model: the hand.
        joint_name: one of JOINT_NAMES, not a tip.
        axes: (3, 3) flexion, abduction and twist axes of that joint; breadth is along the first.
    """
    mesh, skeleton = resting(model), SKELETON_JOINT_NAMES.index(joint_name)
    center = mesh.joints[JOINT_NAMES.index(joint_name)]
    first = 3 * ((skeleton - 1) // 3) + 1
    mine = model.weights[:, first : first + 3].sum(axis=1) > 0.5
    cut = _plane_cut(mesh.vertices, model.faces[mine[model.faces].all(axis=1)], center, axes[2])
    return tuple(float(np.ptp(cut @ axes[k]) * 1e3) for k in (0, 1))  # type: ignore[return-value]


def hand_sizes_mm(model: HandModel) -> dict[str, float]:
    """Length, wrist joint to middle tip; breadth and thickness over the knuckles, without thumb."""
    mesh = resting(model)
    tip, knuckle = (mesh.joints[JOINT_NAMES.index(f"middle_{end}")] for end in ("tip", "mcp"))
    thumb = model.weights[:, 13:16].sum(axis=1) > 0.3
    faces = model.faces[~thumb[model.faces].any(axis=1)]
    cut = _plane_cut(mesh.vertices, faces, knuckle - np.array([-0.01, 0, 0]), np.array([1.0, 0, 0]))
    return {
        "length": float(np.linalg.norm(tip - mesh.joints[0]) * 1e3),
        "breadth": float(np.ptp(cut[:, 2]) * 1e3),
        "thickness": float(np.ptp(cut[:, 1]) * 1e3),
    }


def _plane_cut(v: np.ndarray, faces: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Points where the edges of the faces cross a plane."""
    height = (v - point) @ normal
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    a, b = edges[np.sign(height[edges[:, 0]]) != np.sign(height[edges[:, 1]])].T
    t = height[a] / (height[a] - height[b])
    return v[a] + t[:, None] * (v[b] - v[a])


def volume_ml(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Enclosed volume; the flat wrist loop is closed by a fan about its centre."""
    directed = {(int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3)}
    wrist = sorted({a for a, b in directed if (b, a) not in directed})
    # Measured from the fan's centre, the triangles of the fan add nothing.
    a, b, c = (vertices[faces[:, k]] - vertices[wrist].mean(axis=0) for k in range(3))
    return float(np.einsum("ij,ij->", np.cross(a, b), c) / 6 * 1e6)


def self_intersections(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Count pairs of triangles that cross although they share no vertex."""
    return int(_crossing_pairs(np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int64)))


@numba.njit(cache=True)
def _crossing_pairs(v, f):  # pragma: no cover - compiled
    n = f.shape[0]
    low, high = np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        for c in range(3):
            low[i, c] = min(v[f[i, 0], c], v[f[i, 1], c], v[f[i, 2], c])
            high[i, c] = max(v[f[i, 0], c], v[f[i, 1], c], v[f[i, 2], c])
    order = np.argsort(low[:, 0])
    count = 0
    for first in range(n):
        i = order[first]
        for second in range(first + 1, n):
            j = order[second]
            if low[j, 0] > high[i, 0]:
                break
            apart = low[j, 1] > high[i, 1] or high[j, 1] < low[i, 1]
            apart = apart or low[j, 2] > high[i, 2] or high[j, 2] < low[i, 2]
            if not apart and not _share_vertex(f, i, j) and _triangles_cross(v, f, i, j):
                count += 1
    return count


@numba.njit(cache=True)
def _share_vertex(f, i, j):  # pragma: no cover - compiled
    for a in range(3):
        for b in range(3):
            if f[i, a] == f[j, b]:
                return True
    return False


@numba.njit(cache=True)
def _triangles_cross(v, f, i, j):  # pragma: no cover - compiled
    for a in range(3):
        b = (a + 1) % 3
        if _edge_meets(v[f[i, a]], v[f[i, b]], v[f[j, 0]], v[f[j, 1]], v[f[j, 2]]):
            return True
        if _edge_meets(v[f[j, a]], v[f[j, b]], v[f[i, 0]], v[f[i, 1]], v[f[i, 2]]):
            return True
    return False


@numba.njit(cache=True)
def _edge_meets(p, q, a, b, c):  # pragma: no cover - compiled
    """Moeller & Trumbore 1997, for the open edge p-q."""
    d, e1, e2, s = q - p, b - a, c - a, p - a
    h = np.cross(d, e2)
    det = e1 @ h
    if abs(det) < 1e-18:
        return False
    u = (s @ h) / det
    g = np.cross(s, e1)
    w = (d @ g) / det
    t = (e2 @ g) / det
    return u > 0 and w > 0 and u + w < 1 and 0 < t < 1
