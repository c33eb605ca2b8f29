"""A ring of cameras with chosen lenses, for the formats."""

import numpy as np

from poem_jax.geometry.cameras import pixels_from_normalised
from poem_jax.geometry.distortion import distort, fisheye_lens, stack_lenses
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import transform_points
from tests.rigs import look_at

NO_LENS = np.zeros(5)
FOUR = np.array([-0.2, 0.05, 1e-3, -2e-3, 0.0])
FIVE = np.array([-0.3, 0.06, -4e-3, 3e-3, 0.04])
EIGHT = np.array([0.5, 0.1, 1e-3, -2e-3, 0.01, 0.6, 0.05, 1e-3])
TWELVE = np.array([*EIGHT, 1e-3, -2e-3, 3e-3, 1e-3])
FOURTEEN = np.array([*TWELVE, 0.02, -0.03])
FISHEYE = fisheye_lens(np.array([0.05, -0.02, 0.004, -0.001]))


def ring_of(*lenses, skew=0.0):
    """Return a rig with a camera for each lens around the origin."""
    count = len(lenses)
    angles = np.linspace(0, 4, count)
    places = np.stack([np.cos(angles), 0.9 * np.sin(angles), 0.3 + 0.1 * np.arange(count)], -1)
    T = np.stack([look_at(place, np.array([0.01, 0.02, 0.0]), 0.2 * i) for i, place in enumerate(places)])
    K = np.stack([[[900.0 + i, skew, 640.3 - i], [0, 903, 355.7 + i], [0, 0, 1]] for i in range(count)])
    names = tuple(f"cam_{i}" for i in range(count))
    return Rig(names, np.array([[1280, 720]] * count), K, stack_lenses(lenses), T)


def seen_by(rig, points_world):
    """Return where the cameras of a rig image points of the world: (view, point, 2)."""
    points_cam = transform_points(rig.T_cam_from_world, points_world)
    return pixels_from_normalised(rig.K, distort(points_cam[..., :2] / points_cam[..., 2:], rig.dist))


def some_points(count=40):
    """Return points about the origin, metres."""
    return np.random.default_rng(3).uniform(-0.2, 0.2, (count, 3))
