"""From where a page first looks at hands among their cameras."""

from typing import NamedTuple

import numpy as np

from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import unit_vectors
from poem_jax.typing import Array, Float

_FIELD_OF_VIEW = np.deg2rad(55.0)
_CANDIDATE_VIEWS = 24
_CLEAR_ANGLE = np.deg2rad(30.0)


class View(NamedTuple):
    """Where the page's own camera stands when it opens, in world metres."""

    position: Float[Array, "3"]
    look_at: Float[Array, "3"]
    up: Float[Array, "3"]
    fov: float
    """Vertical field of view, radians."""


def initial_view(points_world: Float[Array, "point 3"], T_cam_from_world: Float[Array, "view 4 4"]) -> View:
    """Choose the page's first view: the points fill a third of it, with as many cameras around as can be.

    "Up" is the mean of the cameras' own up. Directions all around it, slightly from above, are tried: the one
    that shows most cameras is taken, among those from where no camera's picture floats before the hand.
    """
    centre = (points_world.min(0) + points_world.max(0)) / 2
    radius = np.linalg.norm(points_world - centre, axis=-1).max()
    R_world_from_cam = np.swapaxes(T_cam_from_world[:, :3, :3], -1, -2)
    positions = -np.einsum("vij,vj->vi", R_world_from_cam, T_cam_from_world[:, :3, 3])
    up = -R_world_from_cam[:, :, 1].mean(0)
    if np.linalg.norm(up) < 0.1:
        up = -R_world_from_cam[0, :, 1]
    up = unit_vectors(up)
    distance = 3.0 * radius / np.tan(_FIELD_OF_VIEW / 2)
    views = [
        View(centre + distance * direction, centre, up, float(_FIELD_OF_VIEW))
        for direction in _directions(up)
    ]
    return max(views, key=lambda view: _merit(view, positions))


def _directions(up: Float[Array, "3"]) -> Float[Array, "candidate 3"]:
    """Directions around `up`, a little above its equator."""
    ahead = unit_vectors(np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.8 else [0, 1.0, 0]))
    turns = np.linspace(0, 2 * np.pi, _CANDIDATE_VIEWS, endpoint=False)[:, None]
    return unit_vectors(np.cos(turns) * ahead + np.sin(turns) * np.cross(up, ahead) + 0.35 * up)


def _merit(view: View, positions: Float[Array, "view 3"]) -> float:
    """Count the cameras in sight; less than nothing if one stands between the eye and the hand."""
    K, T_eye_from_world = view_camera(view, (3, 4))
    uv, depth = project(K, T_eye_from_world, positions)
    in_sight = (depth > 0) & (uv > 0).all(-1) & (uv < [4, 3]).all(-1)
    to_cameras, to_eye = unit_vectors(positions - view.look_at), unit_vectors(view.position - view.look_at)
    nearest = float((to_cameras @ to_eye).max())
    hidden = nearest > np.cos(_CLEAR_ANGLE)
    return float(in_sight.sum()) - nearest / 10 - (len(positions) + 1) * hidden


def view_camera(view: View, hw: tuple[int, int]) -> tuple[Float[Array, "3 3"], Float[Array, "4 4"]]:
    """Return `K` and `T_cam_from_world` (OpenCV axes) of a page's view in a window of size `hw`."""
    height, width = hw
    focal = height / 2 / np.tan(view.fov / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    z = unit_vectors(view.look_at - view.position)
    x = unit_vectors(np.cross(z, view.up))
    R_cam_from_world = np.stack([x, np.cross(z, x), z])
    T_cam_from_world = np.eye(4)
    T_cam_from_world[:3, :3] = R_cam_from_world
    T_cam_from_world[:3, 3] = -R_cam_from_world @ view.position
    return K, T_cam_from_world
