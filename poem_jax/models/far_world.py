"""Worlds whose origin is far from the hand.

A model works in float32 in the primary camera's frame. A kilometre from the world's origin the extrinsics
themselves would lose a tenth of a millimetre in float32, and their products more. So the world is first moved
to the primary camera, in float64 and outside JAX, and the results are moved back at the very end.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, anchor_to_primary, fill_masked_views
from poem_jax.geometry.transforms import invert_rigid, rotate_points
from poem_jax.typing import Array, Float

LARGEST_ROUNDING = 1e-4
"""Metres. Results farther out than float32 rounds by this are refused."""
_FARTHEST = LARGEST_ROUNDING / (np.finfo(np.float32).eps / 2)


class Origin(NamedTuple):
    """A point of each sample's world as a sum of two float32 numbers, which hold a float64 well enough."""

    coarse: Float[Array, "batch 3"]
    fine: Float[Array, "batch 3"]


def centre_world(
    cams: Cameras, root_world: Float[Array, "batch 3"] | None, dtype: np.dtype
) -> tuple[Cameras, Float[Array, "batch 3"] | None, Origin]:
    """Move each sample's world so that its primary camera stands at the origin; the axes stay.

    Args:
        cams: cameras (batch, view). Under a trace, nothing moves: nothing can be computed outside it.
        root_world: known roots; NaN rows stay NaN.
        dtype: number type of the model's results.

    Returns: cameras and roots in the moved worlds, and where these have their origins in the old ones.

    Raises:
        ValueError: the results would be rounded by more than `LARGEST_ROUNDING`.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((cams, root_world))):
        zero = np.zeros((cams.K.shape[0], 3), np.float32)
        return cams, root_world, Origin(zero, zero)
    mask = np.asarray(cams.view_mask)
    T = np.asarray(cams.T_cam_from_world, np.float64)
    cams = fill_masked_views(Cameras(np.asarray(cams.K), T, mask))
    _, T_primary_from_world = anchor_to_primary(cams.T_cam_from_world, mask)
    centre = invert_rigid(T_primary_from_world)[:, :3, 3]
    if dtype != np.float64:
        _check_distance(centre)
    T = cams.T_cam_from_world.copy()
    T[..., :3, 3] += rotate_points(T[..., :3, :3], centre[:, None, None])[..., 0, :]
    root = None if root_world is None else np.asarray(root_world, np.float64) - centre
    coarse = centre.astype(np.float32)
    moved = cams._replace(T_cam_from_world=T)
    return moved, root, Origin(coarse, (centre - coarse).astype(np.float32))


def move_back(prediction: Prediction, origin: Origin) -> Prediction:
    """Express a prediction of `centre_world`'s cameras in the world that they came from."""

    def moved(points: Array | None, axis: int) -> Array | None:
        if points is None:
            return None
        shape = [1] * points.ndim
        shape[axis], shape[-1] = origin.coarse.shape
        # The small numbers first: then only the last sum rounds.
        return (points + origin.fine.reshape(shape)) + origin.coarse.reshape(shape)

    batch_axes = {
        "vertices_world": 0,
        "joints_world": 0,
        "root_world": 0,
        "layers_world": 1,
        "reference_joints_world": 0,
        "translation": 0,
    }
    return prediction._replace(
        **{name: moved(getattr(prediction, name), axis) for name, axis in batch_axes.items()}
    )


def _check_distance(centre: Float[Array, "batch 3"]) -> None:
    distance = np.abs(centre).max()
    if distance > _FARTHEST:
        raise ValueError(
            f"the primary camera must be within {_FARTHEST:.0f} m of the world's origin along each axis: "
            f"there float32 rounds by {1000 * LARGEST_ROUNDING:g} mm; got {distance:.6g} m. Subtract a point "
            "near the rig from all camera centres, and add it to the results in float64"
        )
