"""Compiled kernels of the synthetic engine: normals, shadows, shading, backgrounds, the camera's development.

All of them release the interpreter's lock and write into buffers that the caller made. Colours are linear
light until `develop`. Per vertex there are `NUM_ATTRIBUTES` numbers, interpolated over a face: place (world),
normal, colour, place in the object's own frame, and the share of the first light that arrives. A material is
a row of `NUM_MATERIAL`: second colour (3), two wave vectors of the pattern that mixes it in (3 + 3), strength
of highlights, share of the first colour kept. A light is (direction, colour), the ambient one (up, sky,
ground).
"""

from typing import no_type_check

import numba
import numpy as np

from poem_jax.geometry.cameras import MIN_DEPTH
from poem_jax.render.zbuffer import corner_weights

NUM_ATTRIBUTES = 13
NUM_MATERIAL = 11
_NORMAL, _ALBEDO, _LOCAL, _LIT = 3, 6, 9, 12
_SKIN = 0
"""Row of the material whose colour comes from the vertices alone."""
_TINY = np.float32(1e-12)
_SAME_DEPTH = np.float32(0.01)


@numba.njit(cache=True, nogil=True)
@no_type_check
def vertex_normals(vertices, faces, normals):
    """Write unit normals, the area-weighted mean of the adjacent faces'; z where a vertex has no area."""
    normals[:] = 0.0
    for i in range(faces.shape[0]):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        e0, e1, e2 = vertices[b] - vertices[a], vertices[c] - vertices[a], 0.0
        x = e0[1] * e1[2] - e0[2] * e1[1]
        y = e0[2] * e1[0] - e0[0] * e1[2]
        e2 = e0[0] * e1[1] - e0[1] * e1[0]
        for corner in (a, b, c):
            normals[corner, 0] += x
            normals[corner, 1] += y
            normals[corner, 2] += e2
    for i in range(normals.shape[0]):
        length = np.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2)
        if length > 0.0:
            normals[i] /= length
        else:
            normals[i, 2] = 1.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def project_points(K, T_cam_from_world, points_world, scale, points_px):
    """Write u, v (pixels times `scale`) and depth; K has no skew. For the inner loop only: no checks."""
    fx, fy, cx, cy = K[0, 0] * scale, K[1, 1] * scale, K[0, 2] * scale, K[1, 2] * scale
    T = T_cam_from_world
    for i in range(points_world.shape[0]):
        x, y, z = points_world[i, 0], points_world[i, 1], points_world[i, 2]
        depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        safe = depth if depth > MIN_DEPTH else MIN_DEPTH
        points_px[i, 0] = fx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / safe + cx
        points_px[i, 1] = fy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / safe + cy
        points_px[i, 2] = depth


@numba.njit(cache=True, nogil=True)
@no_type_check
def vertices_seen(vertices_px, inverse_depth, scale, frame, tolerance, seen):
    """Write whether nothing lies more than `tolerance` metres before a vertex and it is inside the frame.

    `vertices_px` are in supersampled pixels (`scale` per crop pixel), `frame` (x0, y0, x1, y1) in crop
    pixels.
    """
    height, width = inverse_depth.shape
    for i in range(vertices_px.shape[0]):
        u, v, depth = vertices_px[i, 0], vertices_px[i, 1], vertices_px[i, 2]
        inside = (
            depth > 0.0
            and 0.0 <= u < width
            and 0.0 <= v < height
            and frame[0] <= u / scale < frame[2]
            and frame[1] <= v / scale < frame[3]
        )
        seen[i] = inside and inverse_depth[int(v), int(u)] * (depth - tolerance) <= 1.0


@numba.njit(cache=True, nogil=True)
@no_type_check
def lit_share(vertices_px, inverse_depth, bias, lit):
    """Write the share (of 3 x 3 shadow map cells) of a vertex's surroundings that the light reaches."""
    height, width = inverse_depth.shape
    for i in range(vertices_px.shape[0]):
        col, row = int(vertices_px[i, 0]), int(vertices_px[i, 1])
        count, reached = 0, 0
        for r in range(max(0, row - 1), min(height, row + 2)):
            for c in range(max(0, col - 1), min(width, col + 2)):
                count += 1
                reached += inverse_depth[r, c] * (vertices_px[i, 2] - bias) <= 1.0
        lit[i] = reached / count if count > 0 else 1.0


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
@no_type_check
def _paint(point, materials, material, color):
    """Write the colour that a material has at a point: two colours mixed by waves in the object's frame."""
    for k in range(3):
        color[k] = point[_ALBEDO + k]
    if material == _SKIN:
        return
    x, y, z = point[_LOCAL], point[_LOCAL + 1], point[_LOCAL + 2]
    a = np.sin(materials[material, 3] * x + materials[material, 4] * y + materials[material, 5] * z)
    b = np.cos(materials[material, 6] * x + materials[material, 7] * y + materials[material, 8] * z)
    mix = (1.0 - materials[material, 10]) * min(1.0, max(0.0, 0.5 + 4.0 * a * b))
    for k in range(3):
        color[k] += mix * (materials[material, k] - color[k])


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
@no_type_check
def _shade(point, materials, material, lights, ambient, camera_center, color):
    """Write the light that a surface point sends to the camera (all arrays float32).

    Wrapped diffuse light, hemispheric ambient light, Blinn-Phong highlights (Blinn 1977).
    """
    _paint(point, materials, material, color)
    nx, ny, nz = point[_NORMAL], point[_NORMAL + 1], point[_NORMAL + 2]
    scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz + _TINY)
    nx, ny, nz = nx * scale, ny * scale, nz * scale
    vx, vy, vz = camera_center[0] - point[0], camera_center[1] - point[1], camera_center[2] - point[2]
    scale = 1.0 / np.sqrt(vx * vx + vy * vy + vz * vz + _TINY)
    vx, vy, vz = vx * scale, vy * scale, vz * scale
    above = 0.5 + 0.5 * (nx * ambient[0, 0] + ny * ambient[0, 1] + nz * ambient[0, 2])
    diffuse0 = ambient[2, 0] + (ambient[1, 0] - ambient[2, 0]) * above
    diffuse1 = ambient[2, 1] + (ambient[1, 1] - ambient[2, 1]) * above
    diffuse2 = ambient[2, 2] + (ambient[1, 2] - ambient[2, 2]) * above
    shine0, shine1, shine2 = 0.0, 0.0, 0.0
    for i in range(lights.shape[0]):
        lx, ly, lz = lights[i, 0], lights[i, 1], lights[i, 2]
        # Light bleeds a little past the terminator, as it does in skin.
        facing = (nx * lx + ny * ly + nz * lz + 0.2) / 1.2
        if facing <= 0.0:
            continue
        share = point[_LIT] if i == 0 else 1.0
        hx, hy, hz = lx + vx, ly + vy, lz + vz
        glint = max(0.0, (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz + _TINY))
        glint *= glint
        glint *= glint
        glint *= glint
        glint *= glint * share * materials[material, 9]
        facing *= share
        diffuse0 += facing * lights[i, 3]
        diffuse1 += facing * lights[i, 4]
        diffuse2 += facing * lights[i, 5]
        shine0 += glint * lights[i, 3]
        shine1 += glint * lights[i, 4]
        shine2 += glint * lights[i, 5]
    color[0] = color[0] * diffuse0 + shine0
    color[1] = color[1] * diffuse1 + shine1
    color[2] = color[2] * diffuse2 + shine2


@numba.njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def shade_over(surface, lighting, raster, scale, frame, background, tones, image):
    """Shade what the z-buffer holds over a background, averaging `scale` x `scale` samples, into `image`.

    `surface` is (faces, face_material, attributes, materials), `lighting` (lights, ambient, camera_center),
    `raster` (vertices_px, face_index, inverse_depth); `tones` (256, 3) gives the linear light of a
    background's bytes. Neighbouring samples of one material at nearly one depth share a colour. Pixels
    outside `frame` turn black.
    """
    faces, face_material, attributes, materials = surface
    lights, ambient, camera_center = lighting
    vertices_px, face_index, inverse_depth = raster
    color, total = np.zeros(3, np.float32), np.zeros(3, np.float32)
    point = np.zeros(NUM_ATTRIBUTES, np.float32)
    share = np.float32(1.0 / (scale * scale))
    for row in range(image.shape[0]):
        for col in range(image.shape[1]):
            covered, material, near = 0, -1, np.float32(0.0)
            total[:] = 0.0
            for r in range(row * scale, (row + 1) * scale):
                for c in range(col * scale, (col + 1) * scale):
                    face = face_index[r, c]
                    if face < 0:
                        continue
                    depth = inverse_depth[r, c]
                    if face_material[face] != material or abs(depth - near) > _SAME_DEPTH * near:
                        material, near = face_material[face], depth
                        i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
                        weights = corner_weights(vertices_px, i, j, k, c + 0.5, r + 0.5)
                        w0, w1 = np.float32(weights[0]), np.float32(weights[1])
                        w2 = np.float32(1.0) - w0 - w1
                        for n in range(NUM_ATTRIBUTES):
                            point[n] = w0 * attributes[i, n] + w1 * attributes[j, n] + w2 * attributes[k, n]
                        _shade(point, materials, material, lights, ambient, camera_center, color)
                    covered += 1
                    for n in range(3):
                        total[n] += color[n]
            rest = np.float32(1.0) - covered * share
            inside = frame[0] <= col + 0.5 < frame[2] and frame[1] <= row + 0.5 < frame[3]
            for n in range(3):
                light = rest * tones[background[row, col, n], n] + share * total[n]
                image[row, col, n] = light if inside else np.float32(0.0)


@numba.njit(cache=True, nogil=True)
@no_type_check
def count_samples(face_index, num_faces):
    """Return how many samples show a face below `num_faces`."""
    count = 0
    for face in face_index.ravel():
        count += (face >= 0) & (face < num_faces)
    return count


@numba.njit(cache=True, nogil=True)
@no_type_check
def cover(face_index, num_faces, scale, frame, coverage):
    """Write the share of each pixel inside the frame that shows a face below `num_faces`; return its sum."""
    total = 0
    for row in range(coverage.shape[0]):
        for col in range(coverage.shape[1]):
            count = 0
            for r in range(row * scale, (row + 1) * scale):
                for c in range(col * scale, (col + 1) * scale):
                    count += (face_index[r, c] >= 0) & (face_index[r, c] < num_faces)
            if not (frame[0] <= col + 0.5 < frame[2] and frame[1] <= row + 0.5 < frame[3]):
                count = 0
            coverage[row, col] = count / (scale * scale)
            total += count
    return total


@numba.njit(cache=True, nogil=True)
@no_type_check
def develop(image, gains, curve, noise, seed, pixels):
    """Turn linear light into uint8: channel gains, tone curve (a table over [0, 1]), noise from `seed`.

    Noise is the sum of four bytes of an xorshift generator, near enough to a normal and much cheaper.
    """
    state = np.uint64(seed) | np.uint64(1)
    last = curve.shape[0] - 1
    for row in range(image.shape[0]):
        for col in range(image.shape[1]):
            for k in range(3):
                state ^= state << np.uint64(13)
                state ^= state >> np.uint64(7)
                state ^= state << np.uint64(17)
                bytes_ = state >> np.uint64(32)
                total = np.int64(bytes_ & np.uint64(255)) + np.int64(
                    (bytes_ >> np.uint64(8)) & np.uint64(255)
                )
                total += np.int64((bytes_ >> np.uint64(16)) & np.uint64(255)) + np.int64(
                    bytes_ >> np.uint64(24)
                )
                light = min(1.0, max(0.0, image[row, col, k] * gains[k]))
                value = curve[int(light * last)] + noise * (total - 510) / 147.8 + 0.5
                pixels[row, col, k] = np.uint8(min(255.0, max(0.0, value)))
