"""Surfaces besides the hand: the forearm that grows out of the wrist loop, and simple solids.

All lengths are metres; faces run counter-clockwise seen from outside.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.typing import Array, Float, Int

FOREARM_STEPS = np.array([0.06, 0.18, 0.4, 0.401, 0.7, 1.0, 1.0])
"""Places of the forearm's rings along it; the narrow step can carry the hem of a sleeve, the last is the
end."""
_SLEEVE_RING = 3
_SIDES = 16


class Solid(NamedTuple):
    """A closed surface about its own origin, with true normals."""

    vertices: Float[Array, "vert 3"]
    normals: Float[Array, "vert 3"]
    faces: Int[Array, "face 3"]


class Forearm(NamedTuple):
    """Rings of vertices that continue the wrist loop, and the faces between them."""

    vertices: Float[Array, "vert 3"]
    offsets: Float[Array, "vert 3"]
    """The same rings on an unbent hand, relative to the loop's vertices: where the skin's texture is read."""
    faces: Int[Array, "face 3"]
    """Indices into [all hand vertices, forearm vertices]."""
    sleeve: Float[Array, " vert"]
    """1 where a sleeve covers the vertex, else 0."""


def wrist_loop(faces: Int[Array, "face 3"]) -> Int[Array, " edge"]:
    """Return the vertices of the one boundary loop, in the direction in which its faces run along it.

    Raises:
        ValueError: the surface has no boundary, or more than one loop.
    """
    edges = {(int(face[k]), int(face[(k + 1) % 3])) for face in faces for k in range(3)}
    following = {a: b for a, b in edges if (b, a) not in edges}
    if not following:
        raise ValueError("the hand's surface must be open at the wrist; got a closed one")
    loop = [min(following)]
    while following[loop[-1]] != loop[0]:
        loop.append(following[loop[-1]])
    if len(loop) != len(following):
        raise ValueError(
            f"the hand must have one wrist loop; got {len(following)} boundary edges, {len(loop)} in one"
        )
    return np.array(loop)


def forearm_faces(loop: Int[Array, " edge"], num_vertices: int) -> Int[Array, "face 3"]:
    """Return the faces of the tube whose first ring is `loop`, closed by a fan at its end."""
    sides, rings = len(loop), len(FOREARM_STEPS)
    ring = num_vertices + np.arange((rings - 1) * sides).reshape(rings - 1, sides)
    grid = np.concatenate([loop[None], ring])
    near, far = grid[:-1], grid[1:]
    near_next, far_next = np.roll(near, -1, axis=1), np.roll(far, -1, axis=1)
    quads = [np.stack([near_next, near, far], -1), np.stack([near_next, far, far_next], -1)]
    tip = np.full(sides, num_vertices + ring.size)
    fan = np.stack([far_next[-1], far[-1], tip], -1)
    return np.concatenate([*(quad.reshape(-1, 3) for quad in quads), fan]).astype(np.int32)


def grow_forearm(
    loop_points: Float[Array, "edge 3"],
    knuckle: Float[Array, "3"],
    faces: Int[Array, "face 3"],
    *,
    length: float,
    bend: Float[Array, "3"],
    taper: float,
    sleeve: bool,
) -> Forearm:
    """Grow a forearm from the wrist loop of a posed hand.

    Args:
        loop_points: the loop's vertices, in loop order.
        knuckle: a joint of the palm; the arm starts away from it.
        faces: of `forearm_faces`.
        length: of the arm.
        bend: rotation vector (radians) between hand and arm.
        taper: girth at the far end over that at the wrist.
        sleeve: whether a sleeve of greater girth covers the far part.
    """
    center = loop_points.mean(0)
    axis = center - knuckle
    axis /= np.linalg.norm(axis)
    steps = FOREARM_STEPS[:, None, None]
    girth = 1 + (taper - 1) * steps
    if sleeve:
        girth[_SLEEVE_RING:] *= 1.18
    girth[-1] = 0.0
    offsets = (loop_points - center) * girth + axis * (length * steps)
    # The wrist bends over the first fifth of the arm.
    turn = rotation_from_axis_angle(bend * np.minimum(FOREARM_STEPS / 0.18, 1.0)[:, None])
    vertices = np.einsum("rij,rnj->rni", turn, offsets) + center
    covered = np.repeat(np.arange(len(FOREARM_STEPS)) >= _SLEEVE_RING, len(loop_points)) * float(sleeve)
    keep = slice(0, (len(FOREARM_STEPS) - 1) * len(loop_points) + 1)
    rest = offsets - (loop_points - center)
    return Forearm(vertices.reshape(-1, 3)[keep], rest.reshape(-1, 3)[keep], faces, covered[keep])


@cache
def unit_box() -> Solid:
    """Return the cube [-1, 1]^3, every side with its own corners."""
    vertices, normals = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3] * sign
            normal = np.eye(3)[axis] * sign
            vertices += [normal - u - v, normal + u - v, normal + u + v, normal - u + v]
            normals += [normal] * 4
    corner = 4 * np.arange(6)[:, None, None]
    faces = (corner + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Solid(np.array(vertices), np.array(normals), faces.astype(np.int32))


@cache
def unit_cylinder() -> Solid:
    """Return the cylinder of radius 1 about the z axis, z in [-1, 1]."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(_SIDES)], -1)
    down, up = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
    vertices = np.concatenate([rim + down, rim + up, rim + down, rim + up, [down, up]])
    caps = [np.repeat(end[None], _SIDES, axis=0) for end in (down, up)]
    normals = np.concatenate([rim, rim, *caps, [down, up]])
    i, j = np.arange(_SIDES), np.roll(np.arange(_SIDES), -1)
    low, high, n = np.full(_SIDES, 4 * _SIDES), np.full(_SIDES, 4 * _SIDES + 1), _SIDES
    faces = [(i, j, n + j), (i, n + j, n + i), (2 * n + j, 2 * n + i, low), (3 * n + i, 3 * n + j, high)]
    return Solid(vertices, normals, np.concatenate([np.stack(f, -1) for f in faces]).astype(np.int32))


@cache
def unit_sphere(rings: int = 9) -> Solid:
    """Return the sphere of radius 1 as rings of latitude."""
    polar = np.pi * np.arange(1, rings) / rings
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    body = np.concatenate([np.column_stack([circle * np.sin(p), np.full(_SIDES, np.cos(p))]) for p in polar])
    vertices = np.concatenate([body, [[0, 0, 1.0], [0, 0, -1.0]]])
    grid = np.arange(len(body)).reshape(-1, _SIDES)
    upper, lower = grid[:-1].ravel(), grid[1:].ravel()
    upper_next, lower_next = np.roll(grid, -1, 1)[:-1].ravel(), np.roll(grid, -1, 1)[1:].ravel()
    top, bottom = np.full(_SIDES, len(body)), np.full(_SIDES, len(body) + 1)
    faces = [
        (upper, lower, lower_next),
        (upper, lower_next, upper_next),
        (top, grid[0], np.roll(grid[0], -1)),
        (grid[-1], bottom, np.roll(grid[-1], -1)),
    ]
    return Solid(vertices, vertices, np.concatenate([np.stack(f, -1) for f in faces]).astype(np.int32))
