"""A small rig with lenses, its cameras around the origin."""

import numpy as np

from poem_jax.geometry.rig import Rig


def look_at(position, target, roll=0.0):
    """T_cam_from_world of a camera."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.1, 0.2, 1.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    c, s = np.cos(roll), np.sin(roll)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ R
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ position
    return T


def small_rig() -> Rig:
    places = np.array([[0.6, 0.0, 0.2], [0.0, 0.7, 0.3], [-0.5, -0.3, 0.4]])
    K = np.array([[[200.0 + 10 * i, 0.3, 118 - i], [0, 205, 92 + i], [0, 0, 1]] for i in range(3)])
    dist = np.array([[-0.3, 0.05, -0.004, 0.004, 0.06], [0.1, -0.2, 0.0, -0.003, 0.08], [0, 0, 0, 0, 0.0]])
    T = np.stack([look_at(place, np.array([0.01, -0.02, 0.0]), 0.3 * i) for i, place in enumerate(places)])
    return Rig(("left_cam", "front", "cam 3"), np.array([[240, 180]] * 3), K, dist, T)
