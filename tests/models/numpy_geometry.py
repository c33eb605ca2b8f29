"""The geometry of POEM v2 in NumPy, written without the package: the oracle of `test_plain_form.py`.

Every function takes one sample and goes view by view and point by point, as a textbook would. Letters: K, R,
t of one camera; P = K [R|t].
"""

import numpy as np

FALLBACK_ROOT = np.array([0.0, 0.0, 0.5])
SHARPEST_MAP = 0.25
"""Cells squared: narrower heat maps weigh no more in the triangulation."""


def move(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a 4 x 4 transform to points (..., 3)."""
    return points @ T[:3, :3].T + T[:3, 3]


def pixels(K: np.ndarray, T: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points (n, 3): pixels (n, 2) and depths (n,)."""
    in_camera = move(T, points)
    homogeneous = in_camera @ K.T
    return homogeneous[:, :2] / homogeneous[:, 2:], in_camera[:, 2]


def lift(uv: np.ndarray, K: np.ndarray, T: np.ndarray, weights: np.ndarray, *, unit_rows: bool) -> np.ndarray:
    """Triangulate one point seen at `uv` (view, 2); the null vector of the two rows of every view.

    Rows have unit norm; or, as in the release, they keep their length and 1e-7 is added to the divisor.
    """
    rows = []
    for (u, v), intrinsics, extrinsics, weight in zip(uv, K, T, weights, strict=True):
        P = intrinsics @ extrinsics[:3]
        for row in (u * P[2] - P[0], v * P[2] - P[1]):
            rows.append(weight * (row / np.linalg.norm(row) if unit_rows else row))
    x = np.linalg.svd(np.array(rows))[2][-1]
    x = x if x[3] > 0 else -x
    return x[:3] / (x[3] + (0.0 if unit_rows else 1e-7))


def lift_all(
    uv: np.ndarray, K: np.ndarray, T: np.ndarray, weights: np.ndarray | None, *, unit_rows: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate points seen at `uv` (view, point, 2), and tell which lie before all cameras."""
    weights = np.ones(uv.shape[:2]) if weights is None else weights
    if len(uv) < 2:
        return np.zeros((uv.shape[1], 3)), np.zeros(uv.shape[1], bool)
    points = [lift(uv[:, j], K, T, weights[:, j], unit_rows=unit_rows) for j in range(uv.shape[1])]
    before = [all(move(t, point)[2] > 0 for t in T) for point in points]
    return np.array(points), np.array(before)


def spread(heat: np.ndarray) -> float:
    """The variance of a heat map (h, w) that sums to 1, cells squared, summed over both axes."""
    rows, columns = np.indices(heat.shape)
    return sum((heat * (cells - (heat * cells).sum()) ** 2).sum() for cells in (rows, columns))


def read_map(feature_map: np.ndarray, u: float, v: float) -> np.ndarray:
    """Interpolate a map (h, w, c) at (u, v) in cells, whose centres are at + 0.5; zeros around the map."""
    h, w, c = feature_map.shape
    value = np.zeros(c)
    for row in (int(np.floor(v - 0.5)), int(np.floor(v - 0.5)) + 1):
        for column in (int(np.floor(u - 0.5)), int(np.floor(u - 0.5)) + 1):
            if 0 <= row < h and 0 <= column < w:
                share = (1 - abs(v - 0.5 - row)) * (1 - abs(u - 0.5 - column))
                value += share * feature_map[row, column]
    return value


def sample_views(
    feature_maps: np.ndarray,
    K: np.ndarray,
    T: np.ndarray,
    points: np.ndarray,
    image_hw: tuple[int, int],
    *,
    zeros_behind: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Read the maps (view, h, w, c) where points (n, 3) project.

    Returns: features (view, n, c), and projections as shares of width and height (view, n, 2).
    """
    h, w, c = feature_maps.shape[1:]
    features, shares = np.zeros((len(K), len(points), c)), np.zeros((len(K), len(points), 2))
    for view in range(len(K)):
        uv, depth = pixels(K[view], T[view], points)
        for i in range(len(points)):
            if zeros_behind and depth[i] <= 0:
                continue
            shares[view, i] = uv[i] / image_hw[::-1]
            u, v = shares[view, i] * (w, h)
            features[view, i] = read_map(feature_maps[view], u, v)
    return features, shares
