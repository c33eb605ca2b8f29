"""Meshes drawn over camera images: shaded, half transparent, with an outline, hidden by each other's depth.

The caller projects: so the same drawing serves distorted photographs and ideal crops alike.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from poem_jax.render.zbuffer import NO_FACE, rasterise
from poem_jax.typing import Array, Bool, Float, Int, UInt8

_AMBIENT = 0.2


class MeshInView(NamedTuple):
    """A mesh as one camera sees it."""

    vertices_px: Float[Array, "vert 2"]
    """Pixels of the image that is drawn on (it spans [0, W] x [0, H]); NaN = outside what the lens shows."""
    vertices_cam: Float[Array, "vert 3"]
    """Metres, OpenCV camera axes."""
    faces: Int[Array, "face 3"]
    rgb: tuple[int, int, int]
    """Colour, 0 to 255."""


def draw_overlay(
    image: UInt8[Array, "h w 3"], meshes: Sequence[MeshInView], *, opacity: float = 0.75
) -> UInt8[Array, "h w 3"]:
    """Return a copy of an RGB image with the meshes drawn on it, lit from the camera, outlines darkened.

    Faces behind the camera, or with a NaN corner, are left out.
    """
    if not meshes:
        return image.copy()
    scene = _gather(meshes)
    raster = rasterise(scene.vertices, scene.faces, (image.shape[0], image.shape[1]))
    covered = raster.face_index != NO_FACE
    corners = scene.colours[scene.faces[raster.face_index[covered]]]
    colour = np.einsum("pk,pkc->pc", raster.barycentric[covered], corners)
    drawn = image.copy()
    mixed = (1 - opacity) * image[covered] + opacity * colour
    drawn[covered] = np.clip(np.rint(mixed), 0, 255)
    drawn[_outline(covered)] //= 2
    return drawn


def silhouette(meshes: Sequence[MeshInView], hw: tuple[int, int]) -> Bool[Array, "h w"]:
    """Return the pixels whose centre any of the meshes covers."""
    if not meshes:
        return np.zeros(hw, bool)
    scene = _gather(meshes)
    return rasterise(scene.vertices, scene.faces, hw).face_index != NO_FACE


class _Scene(NamedTuple):
    vertices: Float[Array, "vert 3"]
    """Pixels and depth."""
    faces: Int[Array, "face 3"]
    colours: Float[Array, "vert 3"]


def _gather(meshes: Sequence[MeshInView]) -> _Scene:
    """Put all meshes into one, so that they hide each other."""
    first = np.cumsum([0, *(len(mesh.vertices_px) for mesh in meshes)])
    vertices = [np.concatenate([mesh.vertices_px, mesh.vertices_cam[:, 2:]], axis=-1) for mesh in meshes]
    faces = [mesh.faces + start for mesh, start in zip(meshes, first[:-1], strict=True)]
    return _Scene(
        np.concatenate(vertices), np.concatenate(faces), np.concatenate([_shaded(mesh) for mesh in meshes])
    )


def _shaded(mesh: MeshInView) -> Float[Array, "vert 3"]:
    """Colour every vertex by how much its surface faces the camera, where the light is."""
    corners = mesh.vertices_cam[mesh.faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros(mesh.vertices_cam.shape)
    for corner in range(3):
        np.add.at(normals, mesh.faces[:, corner], face_normals)
    lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(mesh.vertices_cam, axis=-1)
    facing = np.abs(np.sum(normals * mesh.vertices_cam, axis=-1)) / np.maximum(lengths, 1e-20)
    light = _AMBIENT + (1 - _AMBIENT) * facing**1.5
    return light[:, None] * np.asarray(mesh.rgb, np.float64)


def _outline(covered: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """Covered pixels with a free neighbour."""
    padded = np.pad(covered, 1, mode="edge")
    inside = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return covered & ~inside
