"""From a lit scene to a camera's picture: z-buffer through the lens, paint and light per sample, sensor."""

from typing import NamedTuple, no_type_check

import cv2
import numba
import numpy as np

from poem_jax.geometry.cameras import pixels_from_normalised
from poem_jax.geometry.distortion import distort
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import transform_points, unit_vectors
from poem_jax.render.zbuffer import NO_FACE, Raster, rasterise
from poem_jax.synthetic.desk.light import KEY, KEY_COLOR, Lit
from poem_jax.synthetic.desk.paint import paint
from poem_jax.synthetic.desk.surface import Surface
from poem_jax.synthetic.shading import develop
from poem_jax.typing import Array, Float, UInt8

SUPERSAMPLE = 2
_NEAR_M = 0.05
_WIDEST = 0.9
"""Tangent of the widest angle off the axis that is drawn: more than the pictures show, less than where the
lenses fold."""
_GAMMA = 0.47
_GAINS = ((1.02, 1.0, 0.96), (1.0, 1.0, 1.0), (0.95, 0.97, 1.0), (1.05, 1.02, 0.98))
"""Of the cameras' channels: no two cameras of a kind are alike."""
_EXPOSURE = 0.86
_BLUR_PX = 0.45
_NOISE = 1.6
"""Standard deviation in pixel values of 255."""


class Picture(NamedTuple):
    """One camera's picture and what lies behind its pixels."""

    image: UInt8[Array, "h w 3"]
    """RGB."""
    depth: Float[Array, "fine_h fine_w"]
    """Along the optical axis, metres, of every sample: `SUPERSAMPLE` squared a pixel."""


def take_picture(scene: Surface, lit: Lit, rig: Rig, view: int, seed: int) -> Picture:
    """Draw a scene as one camera sees it.

    Args:
        scene: all there is.
        lit: the light at its vertices.
        rig: the cameras.
        view: which of them.
        seed: of the sensor's noise.
    """
    width, height = (int(side) * SUPERSAMPLE for side in rig.size_wh[view])
    raster = rasterise(through_lens(scene, rig, view), scene.faces, (height, width), near=_NEAR_M)
    light = _shade(scene, lit, raster, _center(rig, view))
    light = cv2.resize(light, tuple(map(int, rig.size_wh[view])), interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), _BLUR_PX)
    pixels = np.empty(light.shape, np.uint8)
    develop(light, _EXPOSURE * np.array(_GAINS[view]), _tone_curve(), _NOISE, 4 * seed + view + 1, pixels)
    return Picture(pixels, raster.depth)


def through_lens(scene: Surface, rig: Rig, view: int) -> Float[Array, "vert 3"]:
    """Return vertices in samples of the picture, and their depth; 0 where the lens does not show them."""
    points = transform_points(rig.T_cam_from_world[view], scene.vertices)
    depth = points[:, 2]
    rays = points[:, :2] / np.maximum(depth, _NEAR_M)[:, None]
    shown = (depth > _NEAR_M) & (np.linalg.norm(rays, axis=-1) < _WIDEST)
    bent = distort(np.where(shown[:, None], rays, 0.0), rig.dist[view])
    pixels = SUPERSAMPLE * pixels_from_normalised(rig.K[view], bent)
    return np.column_stack([pixels, np.where(shown, depth, 0.0)])


def _shade(scene: Surface, lit: Lit, raster: Raster, center: Float[Array, "3"]) -> Float[Array, "h w 3"]:
    """Return the light that reaches every sample, float32."""
    covered = raster.face_index != NO_FACE
    face = raster.face_index[covered]
    values = (scene.normals, scene.color, scene.local, lit.diffuse, lit.key[:, None], scene.vertices - center)
    ends = np.cumsum([value.shape[1] for value in values])
    of_vertices = np.concatenate(values, axis=1, dtype=np.float32)
    of_samples = np.empty((len(face), ends[-1]), np.float32)
    _interpolate(of_vertices, scene.faces[face], raster.barycentric[covered], of_samples)
    normals, color, local, diffuse, key, away = np.split(of_samples, ends[:-1], axis=1)
    normals, view, window = unit_vectors(normals), unit_vectors(-away), KEY.astype(np.float32)
    painted = paint(scene.material[face], color, local, normals)
    # What is uneven catches more light, or less, from the window.
    relief = 1 + np.float32(0.9) * ((painted.normals - normals) @ window)[:, None]
    half = unit_vectors(view + window)
    glint = np.clip(np.sum(painted.normals * half, -1), 0, 1) ** painted.sharpness
    rim = (1 - np.clip(np.sum(normals * view, -1), 0, 1)) ** 4
    shine = (painted.gloss * (2.2 * glint + 0.5 * rim))[:, None] * key * KEY_COLOR.astype(np.float32)
    light = np.zeros((*covered.shape, 3), np.float32)
    light[covered] = painted.color * diffuse * relief + shine
    return light


@numba.njit(cache=True, nogil=True)
@no_type_check
def _interpolate(of_vertices, corners, weights, of_samples):
    for p in range(len(corners)):
        for n in range(of_vertices.shape[1]):
            total = np.float32(0.0)
            for k in range(3):
                total += weights[p, k] * of_vertices[corners[p, k], n]
            of_samples[p, n] = total


def _center(rig: Rig, view: int) -> Float[Array, "3"]:
    T = rig.T_cam_from_world[view]
    return -T[:3, :3].T @ T[:3, 3]


def _tone_curve() -> Float[Array, " step"]:
    """Return pixel values over linear light: a gamma with a soft shoulder."""
    x = np.linspace(0, 1, 1024)
    return 255 * (x * (1 + 0.25 * x) / (1 + 0.25 * x * x)) ** _GAMMA
