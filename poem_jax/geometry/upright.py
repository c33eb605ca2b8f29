"""Which way is up in a world that a calibration left as it was, and the turn that stands it upright.

Files for animation programs expect y up (glTF 2.0, 3.4; BVH and TRC by habit), while a calibrated world has
any axes.
"""

import numpy as np

from poem_jax.geometry.transforms import unit_vectors
from poem_jax.typing import Array, Float

_NO_DIRECTION = 0.1
"""Directions that cancel each other to less than this say nothing."""


def mean_up(T_cam_from_world: Float[Array, "view 4 4"]) -> Float[np.ndarray, "3"]:
    """Return the unit vector (world frame) that is up for the cameras on average.

    OpenCV cameras have y down. Where their directions cancel out, the first camera decides.
    """
    down = np.asarray(T_cam_from_world, np.float64)[:, 1, :3]
    mean = down.mean(0)
    return -unit_vectors(down[0] if np.linalg.norm(mean) < _NO_DIRECTION else mean)


def upright_rotation(T_cam_from_world: Float[Array, "view 4 4"]) -> Float[np.ndarray, "3 3"]:
    """Return `R_upright_from_world`: y is `mean_up`, and z points to where the first camera stands.

    Who looks along -z, as viewers do when they open a file, looks as the first camera does. If that one
    looks straight down or up, z lies along its image's own vertical instead.
    """
    up = mean_up(T_cam_from_world)
    first = np.asarray(T_cam_from_world, np.float64)[0, :3, :3]
    back = -first[2] + (first[2] @ up) * up
    if np.linalg.norm(back) < _NO_DIRECTION:
        back = first[1] - (first[1] @ up) * up
    back = unit_vectors(back)
    return np.stack([np.cross(up, back), up, back])
