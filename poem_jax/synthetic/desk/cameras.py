"""The four cameras: where they stand, their lenses, and the calibration that a user would have of them."""

import numpy as np

from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import rigid
from poem_jax.typing import Array, Float

SIZE_WH = (640, 480)
FRAMES_PER_SECOND = 15
NUM_FRAMES = 45

_AIM_WORLD = np.array([0.0, 0.0, 0.2])
_STANDS = {
    "cam_0": (-60.0, 33.0, 0.62, 4.0),
    "cam_1": (-18.0, 40.0, 0.64, -2.0),
    "cam_2": (24.0, 32.0, 0.66, 3.0),
    "cam_3": (64.0, 40.0, 0.64, -5.0),
}
"""Azimuth from the y axis towards x and elevation (degrees), distance (metres), roll (degrees)."""
_FOCAL_PX = (652.0, 660.0, 648.0, 655.0)
_CENTRE_PX = ((322.4, 238.1), (317.0, 243.6), (324.8, 240.9), (318.7, 236.2))
_LENSES = (
    (-0.12, 0.03, 0.0006, -0.0004, 0.0),
    (-0.28, 0.11, -0.0009, 0.0007, -0.02),
    (-0.16, 0.05, 0.0004, 0.0008, 0.0),
    (-0.10, 0.02, -0.0005, 0.0003, 0.0),
)


def desk_rig() -> Rig:
    """Return the cameras in the world of the desk."""
    names = tuple(_STANDS)
    K = np.tile(np.eye(3), (len(names), 1, 1))
    K[:, 0, 0], K[:, 1, 1] = _FOCAL_PX, np.array(_FOCAL_PX) * 1.002
    K[:, :2, 2] = _CENTRE_PX
    T = np.stack([_looking_at(*stand) for stand in _STANDS.values()])
    return Rig(names, np.tile(SIZE_WH, (len(names), 1)), K, np.array(_LENSES), T)


def frame_times() -> Float[Array, " frame"]:
    """Return when the frames were taken, seconds since the first."""
    return np.arange(NUM_FRAMES) / FRAMES_PER_SECOND


def _looking_at(azimuth: float, elevation: float, distance: float, roll: float) -> Float[Array, "4 4"]:
    a, e, r = np.radians([azimuth, elevation, roll])
    towards_camera = np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])
    right = np.cross(-towards_camera, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(-towards_camera, right)
    R = np.stack(
        [np.cos(r) * right + np.sin(r) * down, np.cos(r) * down - np.sin(r) * right, -towards_camera]
    )
    return rigid(R, -R @ (_AIM_WORLD + distance * towards_camera))
