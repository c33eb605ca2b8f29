"""Worlds whose origin is far from their cameras: moved near them in float64, before anything is rounded.

A float32 number of 50 km has steps of 4 mm, so that extrinsics and results of such a world cannot be float32.
Seen from a point near the cameras they can. NumPy only: what is traced by JAX has been rounded already.
"""

import numpy as np

from poem_jax.geometry.transforms import invert_rigid
from poem_jax.typing import Array, Float

FAR_M = 100.0
"""Metres. Nearer to its cameras than this, an origin stays where it is: float32 rounds by 4 micrometres."""
MAX_ROUNDING_M = 1e-4
"""Metres. Extrinsics that were rounded by more than this are refused."""


def distant_origin(T_cam_from_world: Float[Array, "*view 4 4"]) -> Float[np.ndarray, "3"]:
    """Return a point amidst cameras that are farther than `FAR_M` from the origin, and (0, 0, 0) for others.

    World frame, metres, float64. Cameras that are not finite are left out.

    Raises:
        ValueError: the extrinsics are not float64, and so far out that they were rounded by more than
            `MAX_ROUNDING_M`.
    """
    T = np.asarray(T_cam_from_world, np.float64)
    centres = invert_rigid(T[np.isfinite(T).all((-2, -1))])[:, :3, 3]
    if not len(centres) or np.abs(centres).max() <= FAR_M:
        return np.zeros(3)
    distance, dtype = float(np.abs(centres).max()), np.asarray(T_cam_from_world).dtype
    if dtype != np.float64 and distance * float(np.finfo(np.float32).eps) / 2 > MAX_ROUNDING_M:
        raise ValueError(
            f"the cameras are {distance:.3g} m from the world's origin; `T_cam_from_world` must be float64 "
            f"there; got {dtype}, which has rounded it to {1000 * np.spacing(np.float32(distance)):.2g} mm: "
            "pass float64, or subtract a point near the cameras first"
        )
    return np.round(centres.mean(0))


def move_origin(
    T_cam_from_world: Float[Array, "*batch 4 4"], origin_world: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Return the extrinsics, float64, for the world whose origin lies at `origin_world`; its axes stay."""
    T = np.array(T_cam_from_world, np.float64)
    T[..., :3, 3] += T[..., :3, :3] @ origin_world
    return T
