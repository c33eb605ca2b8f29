"""A surface of the scene: what is needed of its vertices to paint and light it; and simple shapes."""

import enum
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from poem_jax.synthetic.shading import vertex_normals
from poem_jax.typing import Array, Float, Int


class Material(enum.IntEnum):
    """What a face is made of; `paint.py` says how that looks."""

    SKIN = 0
    KNIT = 1
    WOOD = 2
    WALL = 3
    FLOOR = 4
    GLAZE = 5
    PAPER = 6


class Surface(NamedTuple):
    """Triangles; lengths in metres, world frame."""

    vertices: Float[Array, "vert 3"]
    normals: Float[Array, "vert 3"]
    faces: Int[Array, "face 3"]
    """Counter-clockwise seen from outside."""
    material: Int[Array, " face"]
    color: Float[Array, "vert 3"]
    """Linear RGB."""
    local: Float[Array, "vert 3"]
    """Place in the object's own frame, where its pattern is read."""


def surface(
    vertices: Array, faces: Array, material: Material, color: Array, local: Array | None = None
) -> Surface:
    """Return a smooth surface of one material; `color` may be one for all, `local` is the place itself."""
    vertices = np.ascontiguousarray(vertices, dtype=float)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    normals = np.empty_like(vertices)
    vertex_normals(vertices, faces, normals)
    color = np.broadcast_to(np.asarray(color, float), vertices.shape)
    kinds = np.full(len(faces), material, np.int32)
    return Surface(vertices, normals, faces, kinds, color, vertices if local is None else local)


def join(surfaces: Sequence[Surface]) -> Surface:
    """Put surfaces into one."""
    first = np.cumsum([0, *(len(one.vertices) for one in surfaces)])
    faces = np.concatenate([one.faces + start for one, start in zip(surfaces, first, strict=False)])
    vertices, normals, _, material, color, local = (
        np.concatenate(parts) for parts in zip(*surfaces, strict=True)
    )
    return Surface(vertices, normals, faces.astype(np.int32), material, color, local)


def sheet(
    origin: Array | Sequence[float | int],
    u: Array | Sequence[float | int],
    v: Array | Sequence[float | int],
    step: float,
    material: Material,
    color: Array | Sequence[float | int],
) -> Surface:
    """Return a parallelogram in cells of about `step`, facing u x v; `local` is along u, v in metres."""
    u, v = np.asarray(u, float), np.asarray(v, float)
    columns, rows = (max(1, round(np.linalg.norm(side) / step)) for side in (u, v))
    a, b = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    vertices = np.asarray(origin) + a[..., None] * u + b[..., None] * v
    local = np.stack([a * np.linalg.norm(u), b * np.linalg.norm(v), 0 * a], -1)
    faces = grid_faces(rows + 1, columns + 1, closed=False)
    return surface(vertices.reshape(-1, 3), faces, material, color, local.reshape(-1, 3))


def tube(rings: Float[Array, "ring side 3"], material: Material, color: Array, local: Array) -> Surface:
    """Return the surface through rings of vertices that run counter-clockwise seen from the last ring."""
    faces = grid_faces(*rings.shape[:2], closed=True)
    return surface(rings.reshape(-1, 3), faces, material, color, local.reshape(-1, 3))


def box(
    center: Sequence[float | int],
    half: Sequence[float | int],
    yaw_deg: float,
    material: Material,
    color: Array | Sequence[float | int],
    step: float = 0.02,
) -> Surface:
    """Return an upright box with sharp edges, its sides in cells of about `step`."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) * np.asarray(half)[:, None]
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            out, u, v = sign * axes[axis], axes[(axis + 1) % 3], sign * axes[(axis + 2) % 3]
            sides.append(sheet(center + out - u - v, 2 * u, 2 * v, step, material, color))
    return join(sides)


def grid_faces(rows: int, columns: int, *, closed: bool) -> Int[Array, "face 3"]:
    """Return the triangles of a grid of vertices; `closed` joins its last column to the first."""
    grid = np.arange(rows * columns).reshape(rows, columns)
    if closed:
        grid = np.concatenate([grid, grid[:, :1]], axis=1)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]))
    return np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])


def refine(vertices: Array, faces: Array, extras: Sequence[Array]) -> tuple[Array, Array, list[Array]]:
    """Split every triangle in four; new vertices bulge as the normals at the ends of their edges say.

    Phong tessellation (Boubekeur and Alexa 2008), by three fifths; old vertices stay where they are, and
    first. `extras` are further values a vertex, and get the mean at the new ones.
    """
    normals = np.empty_like(vertices)
    vertex_normals(vertices, faces, normals)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), -1).reshape(-1, 2)
    pairs, place = np.unique(edges, axis=0, return_inverse=True)
    i, j = pairs.T
    middle = (vertices[i] + vertices[j]) / 2
    lifted = middle.copy()
    for end in (i, j):
        lifted -= 0.5 * np.sum((middle - vertices[end]) * normals[end], -1, keepdims=True) * normals[end]
    # Along an open rim the two sides of an edge are not known: it stays straight.
    open_rim = np.bincount(place.ravel()) == 1
    lifted[open_rim] = middle[open_rim]
    m = len(vertices) + place.reshape(-1, 3)
    a, b, c = faces.T
    ab, bc, ca = m.T
    split = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    fine = np.concatenate([np.stack(corner, -1) for corner in split]).astype(np.int32)
    new = middle + 0.6 * (lifted - middle)
    grown = [np.concatenate([values, (values[i] + values[j]) / 2]) for values in extras]
    return np.concatenate([vertices, new]), fine, grown
