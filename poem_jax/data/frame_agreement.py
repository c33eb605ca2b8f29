"""Whether the numbers of a frame fit each other: joints, cameras and key points tell one story, or some lie.

The limits are loose, far beyond what calibrations and fits are off by: what they find is an extrinsic the
wrong way round, a K of another image size, or labels of another sample.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import invert_rigid, transform_points
from poem_jax.typing import Array, Float

LEAST_EXTENT_PX = 2.0
"""Of the longer side around the key points."""
MOST_OFF_PX, MOST_OFF_SHARE = 10.0, 0.25
"""Of key points from the projected joints, median: pixels, or a share of the longer side around the key
points or the projections, whichever is smaller; the larger of the two limits counts."""
MOST_APART_M = 0.1
"""Of the joints that two views put into the world, median."""


def disagreements(
    K: Float[Array, "view 3 3"],
    T_cam_from_world: Float[Array, "view 4 4"],
    joints_cam: Float[Array, "view 21 3"],
    keypoints_px: Float[Array, "view 21 2"],
    names: Sequence[str],
) -> Iterator[str]:
    """Yield what does not fit, a line each, of numbers that are finite and cameras that are cameras.

    Args:
        K: Of the ideal images that `keypoints_px` belong to.
        T_cam_from_world: Of any one world.
        joints_cam: In each camera's frame, metres.
        keypoints_px: The joints in each image.
        names: Of the views.
    """
    K, T_cam_from_world, joints_cam, keypoints_px = (
        np.asarray(array, np.float64) for array in (K, T_cam_from_world, joints_cam, keypoints_px)
    )
    extent = _longer_side(keypoints_px)
    for view in np.flatnonzero(extent < LEAST_EXTENT_PX)[:1].tolist():
        yield f"`keypoints_px` are within {extent[view]:.3g} px of each other in view {names[view]}"
    projected = project_cam(K, joints_cam)
    off = np.median(np.linalg.norm(projected - keypoints_px, axis=-1), axis=-1)
    limit = np.maximum(MOST_OFF_PX, MOST_OFF_SHARE * np.minimum(extent, _longer_side(projected)))
    for view in np.flatnonzero(off > limit)[:1].tolist():
        yield (
            f"`joints_cam` projected by K are {off[view]:.3g} px from `keypoints_px` (median) in view "
            f"{names[view]}; expected at most {limit[view]:.3g}: K, joints and key points do not belong "
            "together"
        )
    world = transform_points(invert_rigid(T_cam_from_world), joints_cam)
    apart = np.median(np.linalg.norm(world[:, None] - world[None], axis=-1), axis=-1)
    one, other = divmod(int(np.argmax(apart)), len(apart))
    if apart[one, other] > MOST_APART_M:
        yield (
            f"views {names[one]} and {names[other]} put the hand to places {apart[one, other]:.3g} m apart "
            f"in the world; expected at most {MOST_APART_M}: extrinsics and labels do not belong together, "
            "or the extrinsics map the other way"
        )


def _longer_side(points: Float[Array, "view point 2"]) -> Float[Array, " view"]:
    return np.ptp(points, axis=1).max(-1)
