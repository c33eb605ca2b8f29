"""Light that arrives at a scene's vertices: a wide window and the room's walls, as many small lamps.

Every lamp has a shadow map, so shadows have soft edges and corners are dark, as far as vertices are close.
Colours are linear RGB.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from poem_jax.geometry.transforms import unit_vectors
from poem_jax.render.zbuffer import draw_faces, empty_buffers
from poem_jax.synthetic.desk.surface import Material, Surface
from poem_jax.typing import Array, Float

KEY = unit_vectors(np.array([0.62, 0.42, 0.72]))
"""Towards the window's middle."""
KEY_COLOR = np.array([1.0, 0.95, 0.87])

_WINDOW_LAMPS, _WINDOW_SPREAD, _WINDOW_POWER = 14, 0.24, 0.98
_SKY_LAMPS, _SKY_POWER = 40, 0.92
_SKY_COLOR = np.array([0.86, 0.93, 1.0])
_BOUNCE = np.array([0.200, 0.150, 0.105])
"""From the desk, upwards; taken to be the same everywhere."""
_WRAP = np.array([0.34, 0.13, 0.09])
"""How far red, green and blue light creeps round an edge within skin."""

_CELLS = 640
_REGION_M = (-0.85, 0.85)
"""Sides of the box about the desk outside of which nothing throws shadows."""
_BIAS_M = 0.004


class Lit(NamedTuple):
    """What arrives at every vertex."""

    diffuse: Float[Array, "vert 3"]
    """Irradiance over pi."""
    key: Float[Array, " vert"]
    """Share of the window that is seen."""


def light_vertices(scene: Surface) -> Lit:
    """Return the light at the vertices of a scene, self-shadowed."""
    directions, colors = _lamps()
    skin = np.zeros(len(scene.vertices), bool)
    skin[scene.faces[scene.material == Material.SKIN]] = True
    wrap = np.where(skin[:, None], _WRAP, 0.02)
    upward = scene.normals[:, 2]
    diffuse = _BOUNCE * (0.5 - 0.5 * upward[:, None]) + 0.05
    key = np.zeros(len(scene.vertices))
    near = np.all((scene.vertices > _REGION_M[0]) & (scene.vertices < _REGION_M[1]), axis=-1)
    casters = scene.faces[near[scene.faces].all(-1)]
    for number, (toward, color) in enumerate(zip(directions, colors, strict=True)):
        share = np.ones(len(scene.vertices))
        share[near] = _reached(scene.vertices, casters, scene.vertices[near], scene.normals[near], toward)
        facing = np.clip((scene.normals @ toward)[:, None] + wrap, 0, None) / (1 + wrap)
        diffuse += share[:, None] * facing * color
        if number < _WINDOW_LAMPS:
            key += share / _WINDOW_LAMPS
    return Lit(diffuse, key)


def _reached(
    vertices: Array, casters: Array, receivers: Array, normals: Array, toward: Array
) -> Float[Array, " receiver"]:
    """Return the share of 2 x 2 cells of a lamp's shadow map about each receiver that are not shaded."""
    aside = unit_vectors(np.cross(toward, np.eye(3)[np.argmin(np.abs(toward))]))
    axes = np.stack([aside, np.cross(toward, aside), -toward], -1)
    scale = _CELLS / (np.ptp(_REGION_M) * 1.3)
    # Far-off lamp: 1/z must be affine over a face as the rasteriser takes it to be; 10 m make it nearly so.
    to_map = axes * [scale, scale, 1.0]
    middle = np.array([_CELLS / 2, _CELLS / 2, 10.0])
    face_index, inverse_depth = empty_buffers((_CELLS, _CELLS))
    draw_faces(vertices @ to_map + middle, casters, 0, False, 1.0, face_index, inverse_depth)
    # Looked up a little off the surface, so that a coarse face does not shade itself.
    slope = np.clip(1 - normals @ toward, 0.2, 1)[:, None]
    at = (receivers + _BIAS_M * slope * normals + 0.5 * _BIAS_M * toward) @ to_map + middle
    columns, rows = np.clip(at[:, :2] - 0.5, 0, _CELLS - 2).astype(int).T
    free = [inverse_depth[rows + i, columns + j] * at[:, 2] <= 1.0 for i in (0, 1) for j in (0, 1)]
    return np.mean(free, axis=0)


@cache
def _lamps() -> tuple[Float[Array, "lamp 3"], Float[Array, "lamp 3"]]:
    """Return directions towards the lamps, the window's first, and their colours."""
    window = _spiral(_WINDOW_LAMPS)
    aside = unit_vectors(np.cross(KEY, [0.0, 0.0, 1.0]))
    disc = window[:, :1] * aside + window[:, 1:] * np.cross(KEY, aside)
    toward_window = unit_vectors(KEY + _WINDOW_SPREAD * disc)
    sky = _spiral(_SKY_LAMPS)
    # Equal areas of the disc below are cosine-weighted directions of the hemisphere above.
    toward_sky = np.column_stack([sky, np.sqrt(1 - np.sum(sky**2, -1))])
    brightness = 1 + 0.5 * toward_sky @ (KEY * [1, 1, 0])
    facing = np.maximum(toward_sky[:, 2:], 0.25)
    colors = _SKY_COLOR * brightness[:, None] * _SKY_POWER / _SKY_LAMPS / facing
    return (
        np.concatenate([toward_window, toward_sky]),
        np.concatenate([np.tile(KEY_COLOR * _WINDOW_POWER / _WINDOW_LAMPS, (_WINDOW_LAMPS, 1)), colors]),
    )


def _spiral(count: int) -> Float[Array, "n 2"]:
    """Return points spread evenly over the unit disc."""
    n = np.arange(count) + 0.5
    angle = np.pi * (1 + np.sqrt(5)) * n
    return np.sqrt(n / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
