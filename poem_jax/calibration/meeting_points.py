"""Where the rays of key points meet: linear triangulation in NumPy, float64, with nothing to compile.

Letters: x = K^-1 (u, v, 1); A stacks the rows x T_2 - T_0 and y T_2 - T_1 of all views, each of unit length;
the point is the eigenvector of A^T A with the smallest eigenvalue (Hartley and Zisserman, 12.2).
"""

import numpy as np

from poem_jax.geometry.cameras import normalised_from_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.typing import Array, Bool, Float

_DETERMINED = 1e-12
"""The second smallest eigenvalue over the largest, below which the rays are one line."""
_FARTHEST = 1e9
"""In units of the rig."""


def near_rig(rig: Rig) -> tuple[Rig, float]:
    """Return a rig whose world is its first camera's frame, in units of its extent, and that extent.

    So that no world is far and no unit is large where squares of lengths are summed.
    """
    T_cam_from_primary = rig.T_cam_from_world @ invert_rigid(rig.T_cam_from_world[0])
    centres = invert_rigid(T_cam_from_primary)[:, :3, 3]
    extent = max(float(np.linalg.norm(centres, axis=-1).max()), 1e-12)
    T_cam_from_primary[:, :3, 3] /= extent
    return rig._replace(T_cam_from_world=T_cam_from_primary), extent


def meeting_points(
    rig: Rig, keypoints_px: Float[Array, "hand view joint 2"]
) -> tuple[Float[Array, "hand joint 3"], Bool[Array, "hand joint"]]:
    """Return the points that best explain their pixels in all views, and whether they are determined.

    Args:
        rig: Cameras about one unit from each other and from the world's origin (`near_rig`).
        keypoints_px: Of the undistorted images (`epipolar.ideal_keypoints`); NaN = unseen.

    Returns: points in the rig's world; zeros where fewer than two views see the joint, or all rays are one.
    """
    seen = np.isfinite(keypoints_px).all(-1)
    rays = normalised_from_pixels(rig.K, np.where(seen[..., None], keypoints_px, 0.0))
    T = rig.T_cam_from_world[:, None]
    rows = rays[..., None] * T[..., 2:3, :] - T[..., :2, :]
    rows = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-300) * seen[..., None, None]
    eigenvalues, vectors = np.linalg.eigh(np.einsum("hvjri,hvjrk->hjik", rows, rows))
    x = vectors[..., 0]
    valid = (seen.sum(1) >= 2) & (eigenvalues[..., 1] > _DETERMINED * eigenvalues[..., 3])
    valid &= np.abs(x[..., 3]) > 1 / _FARTHEST
    points = np.where(valid[..., None], x[..., :3], 0.0) / np.where(valid, x[..., 3], 1.0)[..., None]
    return points, valid
