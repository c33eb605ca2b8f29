"""A z-buffer for triangle meshes on the CPU: the eye of the synthetic engine and of the overlays.

Letters: a face has corners 0, 1, 2 at pixel (u_k, v_k) and depth z_k; w_k are its barycentric weights at a
pixel centre (column + 0.5, row + 0.5). Screen weights and 1/z are affine in the image, so both are stepped
along rows. The kernels are compiled once (cached on disk) and release the interpreter's lock;
`no_type_check` keeps the suite's type checks out of code that numba must compile.
"""

from typing import NamedTuple, no_type_check

import numba
import numpy as np

from poem_jax.typing import Array, Float, Int

NO_FACE = -1
"""Face index of a pixel that no face covers."""


class Raster(NamedTuple):
    """What each pixel centre sees."""

    face_index: Int[Array, "h w"]
    """Row of `faces` nearest to the camera, `NO_FACE` where there is none."""
    barycentric: Float[Array, "h w 3"]
    """Weights of the face's corners at the surface point (perspective-correct); zeros where no face is."""
    depth: Float[Array, "h w"]
    """Depth along the optical axis, metres; infinite where there is no face."""


def rasterise(
    vertices_px: Float[Array, "vert 3"],
    faces: Int[Array, "face 3"],
    hw: tuple[int, int],
    *,
    near: float = 1e-3,
) -> Raster:
    """Find the nearest face, seen from either side, at every pixel centre of an image.

    Args:
        vertices_px: columns u, v in pixels (the image spans [0, W] x [0, H]) and depth in metres.
        faces: rows of vertex indices.
        hw: height and width of the image.
        near: a face with a corner nearer than this (metres) is dropped, as nothing is clipped.

    Returns:
        Face index, barycentric weights and depth per pixel; arrays of the image's size.

    Raises:
        ValueError: a face refers to a vertex that does not exist.
    """
    vertices = np.ascontiguousarray(vertices_px, dtype=np.float64)
    corners = np.ascontiguousarray(faces, dtype=np.int32)
    _check_faces(corners, len(vertices))
    face_index, inverse_depth = empty_buffers(hw)
    draw_faces(vertices, corners, 0, False, near, face_index, inverse_depth)
    barycentric = np.zeros((*hw, 3), dtype=np.float32)
    _fill_barycentric(vertices, corners, face_index, barycentric)
    with np.errstate(divide="ignore"):
        return Raster(face_index, barycentric, 1 / inverse_depth)


def empty_buffers(hw: tuple[int, int]) -> tuple[Int[Array, "h w"], Float[Array, "h w"]]:
    """Return a face index buffer full of `NO_FACE` and an inverse depth buffer of zeros (infinitely far)."""
    return np.full(hw, NO_FACE, dtype=np.int32), np.zeros(hw, dtype=np.float32)


def _check_faces(faces: Int[Array, "face 3"], num_vertices: int) -> None:
    if faces.size and (faces.min() < 0 or faces.max() >= num_vertices):
        raise ValueError(
            f"`faces` must hold vertex indices from 0 to {num_vertices - 1}; "
            f"got {faces.min()} to {faces.max()}"
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def draw_faces(vertices_px, faces, first_face, front_only, near, face_index, inverse_depth):
    """Draw faces into the two buffers, in place; buffers that already hold a scene keep its nearer pixels.

    `faces[i]` is written as `first_face + i`. With `front_only`, faces whose corners do not run
    counter-clockwise when seen from outside are skipped (the image's v axis points down).
    """
    height, width = face_index.shape
    for i in range(faces.shape[0]):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        z0, z1, z2 = vertices_px[a, 2], vertices_px[b, 2], vertices_px[c, 2]
        if not (z0 >= near and z1 >= near and z2 >= near):
            continue
        u0, v0 = vertices_px[a, 0], vertices_px[a, 1]
        u1, v1 = vertices_px[b, 0], vertices_px[b, 1]
        u2, v2 = vertices_px[c, 0], vertices_px[c, 1]
        area = (u1 - u0) * (v2 - v0) - (v1 - v0) * (u2 - u0)
        if not (area < 0.0 or (area > 0.0 and not front_only)):
            continue
        # Clamp before the cast: a far-off corner must not overflow an integer.
        first_col = int(max(0.0, np.ceil(min(u0, u1, u2) - 0.5)))
        last_col = int(min(width - 1.0, np.floor(max(u0, u1, u2) - 0.5)))
        first_row = int(max(0.0, np.ceil(min(v0, v1, v2) - 0.5)))
        last_row = int(min(height - 1.0, np.floor(max(v0, v1, v2) - 0.5)))
        if first_col > last_col or first_row > last_row:
            continue
        du0, dv0 = (v1 - v2) / area, (u2 - u1) / area
        du1, dv1 = (v2 - v0) / area, (u0 - u2) / area
        step_u = du0 / z0 + du1 / z1 - (du0 + du1) / z2
        left, top = first_col + 0.5 - u2, first_row + 0.5 - v2
        for row in range(first_row, last_row + 1):
            w0 = du0 * left + dv0 * (top + row - first_row)
            w1 = du1 * left + dv1 * (top + row - first_row)
            inverse_z = w0 / z0 + w1 / z1 + (1.0 - w0 - w1) / z2
            for col in range(first_col, last_col + 1):
                if w0 >= 0.0 and w1 >= 0.0 and w0 + w1 <= 1.0 and inverse_z > inverse_depth[row, col]:
                    inverse_depth[row, col] = inverse_z
                    face_index[row, col] = first_face + i
                w0 += du0
                w1 += du1
                inverse_z += step_u


@numba.njit(cache=True, nogil=True, inline="always", error_model="numpy")
@no_type_check
def corner_weights(vertices_px, a, b, c, u, v):
    """Return the perspective-correct barycentric weights of pixel position (u, v) in face (a, b, c)."""
    u2, v2 = vertices_px[c, 0], vertices_px[c, 1]
    du0, dv0 = vertices_px[a, 0] - u2, vertices_px[a, 1] - v2
    du1, dv1 = vertices_px[b, 0] - u2, vertices_px[b, 1] - v2
    area = du0 * dv1 - dv0 * du1
    w0 = ((u - u2) * dv1 - (v - v2) * du1) / area
    w1 = ((v - v2) * du0 - (u - u2) * dv0) / area
    q0, q1, q2 = w0 / vertices_px[a, 2], w1 / vertices_px[b, 2], (1.0 - w0 - w1) / vertices_px[c, 2]
    total = q0 + q1 + q2
    return q0 / total, q1 / total, q2 / total


@numba.njit(cache=True, nogil=True)
@no_type_check
def _fill_barycentric(vertices_px, faces, face_index, barycentric):
    for row in range(face_index.shape[0]):
        for col in range(face_index.shape[1]):
            face = face_index[row, col]
            if face >= 0:
                w0, w1, w2 = corner_weights(
                    vertices_px, faces[face, 0], faces[face, 1], faces[face, 2], col + 0.5, row + 0.5
                )
                barycentric[row, col, 0] = w0
                barycentric[row, col, 1] = w1
                barycentric[row, col, 2] = w2
