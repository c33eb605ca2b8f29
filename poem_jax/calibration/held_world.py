"""The world in which most cameras stand where they stood: key points fix neither it nor its scale."""

import numpy as np
from scipy.optimize import least_squares

from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    invert_rigid,
    rigid,
    rotation_from_axis_angle,
)
from poem_jax.typing import Array, Float

_ALIGN = 1e-3
"""Radians, or shares of the extent, beyond which a camera counts as moved when the world is held."""
_ROUNDS = 30
"""Of weights, each from the distances before."""
_NEAREST = 0.05
"""In units of `_ALIGN`: below it no camera counts for more."""


def camera_moves(T_given: Float[Array, "view 4 4"], T: Float[Array, "view 4 4"]) -> Float[Array, "view 6"]:
    """Return how each camera is turned (radians) and moved against where it was, in its own frame."""
    change = T @ invert_rigid(T_given)
    return np.concatenate([axis_angle_from_rotation(change[:, :3, :3]), change[:, :3, 3]], -1)


def world_as_given(
    T_given: Float[Array, "view 4 4"], T: Float[Array, "view 4 4"]
) -> Float[Array, "view 4 4"]:
    """Move and scale the world of `T` so that most cameras stand where they stood.

    Args:
        T_given: The cameras as they were, about one unit from each other and from the world's origin.
        T: The cameras now, in any world and scale.

    Returns: `T` in the world of `T_given`. The sum of the cameras' distances is least, not of their squares:
        so one that was moved moves no other.
    """

    def moved(x: Array) -> Array:
        R, shift, scale = rotation_from_axis_angle(x[:3]), x[3:6], np.exp(x[6])
        # x_old_world = scale R x_new_world + shift, and lengths in the cameras grow by the scale.
        R_cam = T[:, :3, :3] @ R.T
        t = scale * T[:, :3, 3] - R_cam @ shift
        return rigid(R_cam, t)

    def off(x: Array) -> Array:
        return np.linalg.norm(camera_moves(T_given, moved(x)) / _ALIGN, axis=-1)

    start = least_squares(lambda x: (camera_moves(T_given, moved(x)) / _ALIGN).ravel(), np.zeros(7))
    x = start.x
    for _ in range(_ROUNDS):
        # Each camera's distance, not its square.
        weight = 1 / np.sqrt(np.maximum(off(x), _NEAREST))[:, None]
        x = least_squares(lambda x, w=weight: (w * camera_moves(T_given, moved(x)) / _ALIGN).ravel(), x).x
    return moved(x)
