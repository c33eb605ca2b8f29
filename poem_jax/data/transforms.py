"""Boxes around hands: what part of a full frame a model is fed.

Boxes are (x0, y0, x1, y1) in pixels where the image spans [0, W] x [0, H]; they may reach beyond the image,
and what lies there is black.
"""

import numpy as np

from poem_jax.typing import Array, Float


def square_box(points_px: Float[Array, "*batch point 2"], expand_ratio: float) -> Float[Array, "*batch 4"]:
    """Return the square box around points (reader of POEM v2: half-way between the extremes).

    Args:
        points_px: all count, also those outside the image.
        expand_ratio: side of the box over the longer side of the points' bounding box.
    """
    low, high = points_px.min(-2), points_px.max(-2)
    side = expand_ratio * (high - low).max(-1)
    return box_from_center((low + high) / 2, side)


def box_from_center(
    center_px: Float[Array, "*batch 2"], side_px: Float[Array, "*batch"]
) -> Float[Array, "*batch 4"]:
    """Return the square box of a given centre and side."""
    half = np.asarray(side_px)[..., None] / 2
    return np.concatenate([center_px - half, center_px + half], axis=-1)


def jitter_box(
    box_px: Float[Array, "*batch 4"],
    normal: Float[Array, "*batch 3"],
    center_jitter: float,
    scale_jitter: float,
) -> Float[Array, "*batch 4"]:
    """Move a square box by `center_jitter` of its side and scale it by 1 + `scale_jitter`.

    Args:
        box_px: square boxes.
        normal: standard normal numbers: shift in u and v, scale. Scales below 0.5 are held there.
        center_jitter: spread of the centre over the side of the box.
        scale_jitter: spread of the side over the side.
    """
    side = box_px[..., 2] - box_px[..., 0]
    center = (box_px[..., :2] + box_px[..., 2:]) / 2 + normal[..., :2] * (center_jitter * side)[..., None]
    return box_from_center(center, side * np.maximum(1 + scale_jitter * normal[..., 2], 0.5))
