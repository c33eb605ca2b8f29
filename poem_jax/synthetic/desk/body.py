"""The person as far as the cameras see it: two hands, forearms in knitted sleeves, and the upper body."""

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from poem_jax.geometry.transforms import rotate_points, smallest_rotation, unit_vectors
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import ROOT_JOINT, WRIST
from poem_jax.synthetic.desk.motion import SIDES, HandsAtTime
from poem_jax.synthetic.desk.surface import Material, Surface, grid_faces, join, refine, surface, tube
from poem_jax.synthetic.shading import vertex_normals
from poem_jax.synthetic.skin import SkinMap, map_skin
from poem_jax.synthetic.surfaces import wrist_loop
from poem_jax.typing import Array, Float, Int

_SKIN = np.array([0.62, 0.335, 0.225])
_FLUSHED = np.array([1.10, 0.80, 0.76])
_NAIL = np.array([0.74, 0.43, 0.36])
_KNIT = np.array([0.050, 0.088, 0.135])

_FOREARM_M = 0.27
_ELBOW_RIGHT = np.array([0.265, -0.27, 0.035])
"""Where the right elbow would like to be; the forearm keeps its length."""
_SHOULDER_RIGHT = np.array([0.165, -0.415, 0.375])
_BARE_M = 0.075
"""Of the forearm, from the wrist's loop to the cuff."""
_SLEEVE_RADIUS_M = (0.041, 0.049, 0.056, 0.063)
"""At the cuff, below the elbow, at the elbow, at the shoulder."""
_SIDES_OF_SLEEVE = 40


class _HandSurface(NamedTuple):
    faces: Int[Array, "face 3"]
    loop: Int[Array, " edge"]
    skin: SkinMap
    color: Float[Array, "vert 3"]


def body_surface(hands: HandsAtTime) -> Surface:
    """Return everything of the person that the cameras see."""
    parts = [_torso()]
    for side, vertices, joints in zip(SIDES, hands.vertices_world, hands.joints_world, strict=True):
        parts += _hand_and_arm(side, vertices.astype(float), joints.astype(float))
    return join(parts)


@cache
def _hand_surface(side: str) -> _HandSurface:
    hand = default_hand(side)
    faces = np.ascontiguousarray(hand.faces, np.int32)
    template = np.asarray(hand.v_template, float)
    normals = np.empty_like(template)
    vertex_normals(template, faces, normals)
    skin = map_skin(hand, normals)
    color = np.tile(_SKIN, (len(template), 1))
    color *= 1 + (0.55 * skin.red + 0.22 * skin.palm)[:, None] * (_FLUSHED - 1)
    color *= 1 + (0.10 * skin.palm - 0.16 * skin.crease * (1 - skin.nail))[:, None]
    color += skin.nail[:, None] * (_NAIL - color)
    # Counter-clockwise seen from the forearm, as `grid_faces` wants its rows.
    return _HandSurface(faces, wrist_loop(faces)[::-1], skin, color)


def _hand_and_arm(side: str, vertices: Array, joints: Array) -> list[Surface]:
    """Return hand and bare forearm as one skin, and the sleeve, which goes on to the shoulder."""
    one = _hand_surface(side)
    mirror = np.array([-1.0 if side == "left" else 1.0, 1, 1])
    loop = vertices[one.loop]
    start = loop.mean(0)
    elbow = start + _FOREARM_M * unit_vectors(_ELBOW_RIGHT * mirror - start)
    axis = unit_vectors(start - joints[ROOT_JOINT] + 0.3 * (joints[WRIST] - joints[ROOT_JOINT]))
    line = _bent_line(start, axis, elbow, _SHOULDER_RIGHT * mirror)
    rings, local = _bare_forearm(line, loop, axis, one.skin.rest[one.loop])
    index = np.concatenate([one.loop[None], len(vertices) + np.arange(rings[1:, :, 0].size).reshape(-1, 16)])
    strip = index.ravel()[grid_faces(*index.shape, closed=True)]
    skin = np.concatenate([vertices, rings[1:].reshape(-1, 3)])
    rest = np.concatenate([one.skin.rest, local[1:].reshape(-1, 3)])
    color = np.concatenate([one.color, np.tile(_SKIN, (len(skin) - len(vertices), 1))])
    fine, faces, (color, rest) = refine(skin, np.concatenate([one.faces, strip]), [color, rest])
    return [surface(fine, faces, Material.SKIN, color, rest), _sleeve(line)]


def _bent_line(start: Array, axis: Array, elbow: Array, shoulder: Array) -> Float[Array, "point 3"]:
    """Return points every 5 mm along the arm's middle: it leaves the wrist along `axis`, and bends at the
    elbow as flesh does."""
    forearm = elbow - start
    length = np.linalg.norm(forearm)
    s = np.arange(0, length, 0.005)[:, None]
    leave = s * np.exp(-s / 0.03) * (axis - forearm / length)
    lower = start + s * forearm / length + leave
    upper_length = np.linalg.norm(shoulder - elbow)
    upper = elbow + np.arange(0, upper_length, 0.005)[:, None] * (shoulder - elbow) / upper_length
    points = np.concatenate([lower, upper])
    kernel = np.hanning(17) / np.hanning(17).sum()
    padded = np.pad(points, ((8, 8), (0, 0)), mode="edge")
    soft = np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in range(3)], -1)
    near_elbow = np.exp(-((np.arange(len(points)) - len(lower)) ** 2) / 200.0)[:, None]
    return points + near_elbow * (soft - points)


def _bare_forearm(line: Array, loop: Array, axis: Array, rest_loop: Array) -> tuple[Array, Array]:
    """Return rings (ring, edge, 3) that continue the wrist's loop, and where they lie at rest."""
    count = int((_BARE_M + 0.02) / 0.005)
    tangents = unit_vectors(np.gradient(line, axis=0)[:count])
    tangents[0] = axis
    turn = smallest_rotation(np.broadcast_to(axis, tangents.shape), tangents)
    offsets = loop - loop.mean(0)
    along = 0.005 * np.arange(count)[:, None, None]
    swollen = np.broadcast_to(offsets, (count, *offsets.shape)) * (1 + 1.1 * along)
    away = np.array([np.sign(rest_loop[:, 0].mean()), 0, 0])
    return line[:count, None] + rotate_points(turn, swollen), rest_loop + along * away


def _sleeve(line: Array) -> Surface:
    first = int(_BARE_M / 0.005)
    line = line[first:]
    count = len(line)
    tangents = unit_vectors(np.gradient(line, axis=0))
    # A ring turns with the line as little as it can.
    ring = [np.cross(tangents[0], [0.0, 0.0, 1.0])]
    for before, after in pairwise(tangents):
        ring.append(smallest_rotation(before, after) @ ring[-1])
    a = unit_vectors(np.stack(ring))
    b = np.cross(tangents, a)
    s = 0.005 * np.arange(count)
    radius = np.interp(s, [0.0, 0.1, 0.2, s[-1]], _SLEEVE_RADIUS_M)
    # A ribbed cuff holds the sleeve in; folds gather above it and in the elbow.
    radius *= 1 - 0.10 * np.exp(-((s - 0.02) ** 2) / 0.018**2) + 0.05 * np.exp(-((s - 0.055) ** 2) / 0.015**2)
    angle = 2 * np.pi * np.arange(_SIDES_OF_SLEEVE) / _SIDES_OF_SLEEVE
    fold = np.sin(95 * s[:, None] + 2.2 * np.sin(angle)[None] + 1.3 * np.sin(2 * angle + 30 * s[:, None]))
    fold *= 0.028 * np.clip((s[:, None] - 0.045) / 0.03, 0, 1)
    thick = radius[:, None] * (1 + fold)
    thick[0] *= 0.80
    # The end within the shoulder is round.
    last = np.clip((s[-1] - s) / 0.06, 0, 1)
    thick *= np.sqrt(1 - (1 - last[:, None]) ** 2)
    around = np.cos(angle)[None, :, None] * a[:, None] + np.sin(angle)[None, :, None] * b[:, None]
    rings = line[:, None] + thick[..., None] * around
    local = np.stack(
        np.broadcast_arrays(0.27 * angle / (2 * np.pi), s[:, None], 1.0 * (s[:, None] < 0.045)), -1
    )
    return tube(rings, Material.KNIT, _KNIT, local)


@cache
def _torso() -> Surface:
    """Return chest and shoulders: rings of rounded rectangles, narrower above; the head is out of sight."""
    heights = np.linspace(-0.30, 0.47, 60)
    width = np.interp(heights, [-0.3, 0.0, 0.22, 0.36, 0.43, 0.47], [0.19, 0.185, 0.20, 0.205, 0.13, 0.07])
    depth = np.interp(heights, [-0.3, 0.0, 0.22, 0.36, 0.43, 0.47], [0.13, 0.12, 0.125, 0.11, 0.08, 0.06])
    angle = 2 * np.pi * np.arange(72) / 72
    x, y = (np.sign(f) * np.abs(f) ** 0.75 for f in (np.cos(angle), np.sin(angle)))
    fold = 0.010 * np.sin(23 * heights[:, None] + 3 * np.sin(2 * angle) + 1.5 * np.cos(3 * angle))
    rings = np.stack(
        np.broadcast_arrays(width[:, None] * x, (depth[:, None] + fold) * y - 0.42, heights[:, None]), -1
    )
    local = np.stack(np.broadcast_arrays(1.1 * angle / (2 * np.pi), heights[:, None] + 5, 0.0), -1)
    faces = grid_faces(len(heights), len(angle), closed=True)
    return surface(rings.reshape(-1, 3), faces, Material.KNIT, _KNIT, local.reshape(-1, 3))
