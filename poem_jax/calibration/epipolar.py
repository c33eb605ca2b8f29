"""How far key points lie from each other's epipolar lines, camera pair by camera pair; NumPy, float64.

Two views of one point satisfy x_b^T F x_a = 0 with F = K_b^-T [t]x R K_a^-1 and (R, t) = T_b_from_a.
"""

from itertools import combinations

import numpy as np

from poem_jax.geometry.distortion import distort_pixels, undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid, skew_matrix
from poem_jax.typing import Array, Float

MIN_POINTS = 21
"""Of a pair of cameras, below which their median distance says nothing."""
_MISSED_PX = 0.5


def ideal_keypoints(
    rig: Rig, keypoints_px: Float[Array, "frame hand view joint 2"]
) -> Float[Array, "frame hand view joint 2"]:
    """Return the key points of the undistorted images with the rig's `K`.

    NaN stays NaN; points beyond the fold of a lens, which no ray reaches, become NaN.
    """
    by_view = np.moveaxis(np.nan_to_num(keypoints_px), 2, 0)
    flat = by_view.reshape(rig.num_views, -1, 2)
    ideal = undistort_pixels(flat, rig.K, rig.dist)
    missed = np.linalg.norm(distort_pixels(ideal, rig.K, rig.dist) - flat, axis=-1, keepdims=True)
    ideal = np.where(missed < _MISSED_PX, ideal, np.nan)
    ideal = np.moveaxis(ideal.reshape(by_view.shape), 0, 2)
    return np.where(np.isfinite(keypoints_px), ideal, np.nan)


def epipolar_distances_px(
    rig: Rig, keypoints_px: Float[Array, "frame hand view joint 2"]
) -> Float[Array, "view view"]:
    """Return the median distance of key points from their epipolar lines for every pair of cameras.

    Args:
        rig: The cameras.
        keypoints_px: Of the undistorted images (`ideal_keypoints`); NaN = unseen.

    Returns: Pixels of the undistorted images; NaN on the diagonal and where a pair shares fewer than
        `MIN_POINTS` key points.
    """
    distances = np.full((rig.num_views, rig.num_views), np.nan)
    points = np.moveaxis(keypoints_px, 2, 0).reshape(rig.num_views, -1, 2)
    for a, b in combinations(range(rig.num_views), 2):
        distances[a, b] = distances[b, a] = median_distance(
            fundamental_matrix(rig, a, b), points[a], points[b]
        )
    return distances


def fundamental_matrix(rig: Rig, a: int, b: int) -> Float[Array, "3 3"]:
    """Return F with x_b^T F x_a = 0 for pixels of the undistorted images of cameras a and b."""
    T_b_from_a = rig.T_cam_from_world[b] @ invert_rigid(rig.T_cam_from_world[a])
    essential = skew_matrix(T_b_from_a[:3, 3]) @ T_b_from_a[:3, :3]
    return np.linalg.inv(rig.K[b]).T @ essential @ np.linalg.inv(rig.K[a])


def median_distance(
    F: Float[Array, "3 3"], points_a: Float[Array, "point 2"], points_b: Float[Array, "point 2"]
) -> float:
    """Return the median of `point_distances`; NaN for fewer than `MIN_POINTS` pairs."""
    found = point_distances(F, points_a, points_b)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if len(found) >= MIN_POINTS else np.nan


def point_distances(
    F: Float[Array, "3 3"], points_a: Float[Array, "*point 2"], points_b: Float[Array, "*point 2"]
) -> Float[Array, "*point"]:
    """Return the first-order geometric distance of pairs of points from x_b^T F x_a = 0, pixels.

    |x_b^T F x_a| / |(F x_a, F^T x_b)_xy| (Hartley and Zisserman, 11.9); NaN where a point is NaN, or F is
    zero, as of two cameras at one place.
    """
    ones = np.ones((*points_a.shape[:-1], 1))
    a, b = np.concatenate([points_a, ones], -1), np.concatenate([points_b, ones], -1)
    lines_b, lines_a = a @ F.T, b @ F
    slope = np.sqrt((lines_a[..., :2] ** 2).sum(-1) + (lines_b[..., :2] ** 2).sum(-1))
    return np.abs((lines_b * b).sum(-1)) / np.where(slope > 0, slope, np.nan)


def pair_distances_px(
    rig: Rig, keypoints_px: Float[Array, "frame hand view joint 2"], cap_px: float
) -> Float[Array, "pair frame hand joint"]:
    """Return how far the key points of every pair of cameras lie from each other's epipolar lines.

    Args:
        rig: The cameras.
        keypoints_px: In pixels of the raw images; NaN = unseen.
        cap_px: No distance counts for more, and points that no ray reaches count for as much.

    Returns: Pixels of the undistorted images, pairs in the order of `itertools.combinations`; NaN where one
        of the two does not see the point.
    """
    ideal = np.moveaxis(ideal_keypoints(rig, keypoints_px), 2, 0)
    seen = np.moveaxis(np.isfinite(keypoints_px).all(-1), 2, 0)
    distances = []
    for a, b in combinations(range(rig.num_views), 2):
        found = point_distances(fundamental_matrix(rig, a, b), ideal[a], ideal[b])
        capped = np.where(np.isfinite(found), np.minimum(found, cap_px), cap_px)
        distances.append(np.where(seen[a] & seen[b], capped, np.nan))
    return np.stack(distances)
