"""The mesh: rings of ten vertices along each finger, two sheets for the palm and the back (design frame, mm).

Finger rings sit where bends need them: three at every joint. The sheets meet the fingers in their root
rings and each other along the outline of the palm and in the webs; they are planar Delaunay triangulations
lifted on to the implicit surface and relaxed there. Counts are exact: 778 vertices and one boundary loop of
16 edges.

Ring numbering: 0 = radial side, 1-4 = back of the hand, 5 = ulnar side, 6-9 = palm's side (towards radial
again). Neighbouring fingers share one vertex, the middle of their web: number 5 of one is number 0 of the
next.
"""

from typing import NamedTuple

import numpy as np
from hand_design.anatomy import FINGERS, SKELETON
from hand_design.surface import PROFILES, distance, project
from hand_design.triangles import flipped, inside, oriented, scatter
from scipy.spatial import Delaunay

RING = 10
WRIST_RING = 16
NUM_VERTICES = 778
_BEND_MM = 5.0
_WRIST_U = -12.0
_THUMB_WEB = ((61.5, 36.6, -10.3), (71.0, 36.2, -8.0), (82.0, 37.0, -5.0), (94.1, 37.4, -2.0))
"""Where the outline of the palm runs from the thumb to the index finger."""
_BACK, _FRONT = (1, 2, 3, 4), (9, 8, 7, 6)
_TIE_MM = 1e-9
# fmt: off
_OTHER_WAY = frozenset((
    113, 133, 138, 143, 148, 163, 173, 199, 209, 214, 219, 229, 290, 300,
    310, 350, 386, 401, 406, 421, 436, 446, 451, 461, 496, 510, 519, 524,
))
# fmt: on
"""Quads (by their first vertex) at the sides of the fingers whose diagonals are equally long, and which the
shipped hand cuts from b to c. No rule gives them: rounding on one machine chose; now they are the hand."""


class Mesh(NamedTuple):
    """A triangle mesh and what is known of its parts."""

    vertices: np.ndarray
    faces: np.ndarray
    rings: dict[str, np.ndarray]
    """(rings, 10) vertex numbers per finger, root ring first."""
    stations: dict[str, np.ndarray]
    """Station of each ring along its finger."""
    tips: dict[str, np.ndarray]
    """(6,) per finger: the pole, then the ring of five around it."""
    wrist: np.ndarray
    """(16,) boundary loop: 0 = radial side, 1-7 = back, 8 = ulnar side, 9-15 = palm."""


def _stations(name: str) -> np.ndarray:
    first, second, third = np.linalg.norm(np.diff(SKELETON[name].joints, axis=0), axis=1)
    d = _BEND_MM
    if name == "thumb":
        pad = (2.5, 2.82)
        joint1 = (1 - d / first, 1.0, 1 + d / second)
        joint2 = (1.52, 2 - d / second, 2.0, 2 + d / third)
        return np.array([*joint1, *joint2, *pad])
    root = (0.72,)
    joint1 = (1 - d / first, 1.0, 1 + d / second)
    joint2 = (2 - d / second, 2.0, 2 + d / third)
    return np.array([*root, *joint1, *joint2, 2.5, 2.82])


def _ring(name: str, station, numbers=None) -> np.ndarray:
    """Vertices of one ring, square to the finger's axis."""
    profile = PROFILES[name]
    axis = profile.direction(float(station))
    up = np.array([0.0, 0.0, 1.0]) - axis * axis[2]
    up /= np.linalg.norm(up)
    side = np.cross(up, axis)
    numbers = np.arange(RING) if numbers is None else np.asarray(numbers)
    angles = 2 * np.pi * numbers / RING
    spokes = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * up
    cos, sin = profile.angle(axis, spokes)
    return profile.center(station) + profile.radius(float(station), cos, sin)[:, None] * spokes


def _tip(name: str) -> np.ndarray:
    """The pole and five vertices around it."""
    ring = _ring(name, 2.95, np.arange(5) * 2 + 1)
    return np.vstack([PROFILES[name].center(3.0)[None], ring])


class _Builder:
    def __init__(self):
        self.points: list[np.ndarray] = []
        self.faces: list[tuple[int, int, int]] = []

    def add(self, points) -> np.ndarray:
        start = len(self.points)
        self.points.extend(np.atleast_2d(points))
        return np.arange(start, len(self.points))

    def strip(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Join two rings by quads, each cut along its shorter diagonal; ties as `_OTHER_WAY` records."""
        p = self.points
        for k in range(len(lower)):
            a, b = lower[k], lower[(k + 1) % len(lower)]
            c, d = upper[k], upper[(k + 1) % len(upper)]
            excess = np.linalg.norm(p[a] - p[d]) - np.linalg.norm(p[b] - p[c])
            tied = abs(excess) < _TIE_MM
            if (tied and a not in _OTHER_WAY) or (not tied and excess < 0):
                self.faces += [(a, b, d), (a, d, c)]
            else:
                self.faces += [(a, b, c), (b, d, c)]

    def cap(self, ring: np.ndarray, tip: np.ndarray) -> None:
        pole, five = tip[0], tip[1:]
        for k in range(5):
            a, b, c = (ring[(2 * k + i) % RING] for i in (1, 2, 3))
            p, q = five[k], five[(k + 1) % 5]
            self.faces += [(a, b, p), (b, q, p), (b, c, q), (p, q, pole)]


def _finger_tubes(build: _Builder):
    rings, stations, tips = {}, {}, {}
    for name in FINGERS:
        stations[name] = _stations(name)
        rings[name] = [build.add(_ring(name, s)) for s in stations[name]]
        tips[name] = build.add(_tip(name))
        for lower, upper in zip(rings[name][:-1], rings[name][1:], strict=True):
            build.strip(lower, upper)
        build.cap(rings[name][-1], tips[name])
    return rings, stations, tips


def _root_rings(build: _Builder) -> dict[str, np.ndarray]:
    """Rings where fingers leave the palm; their side vertices lie further out, in the webs."""
    roots: dict[str, np.ndarray] = {}
    for name in FINGERS:
        points = np.vstack([_ring(name, s, [k]) for k, s in enumerate(_root_stations(name))])
        sides = points[[0, 5]]
        ring = np.empty(RING, int)
        ring[list(_BACK)] = build.add(points[list(_BACK)])
        ring[list(_FRONT)] = build.add(points[list(_FRONT)])
        if name in ("thumb", "index"):
            ring[0] = build.add(sides[0])[0]
        else:
            last = FINGERS[FINGERS.index(name) - 1]
            ring[0] = roots[last][5]
            build.points[ring[0]] = _web_point(last, name)
        ring[5] = build.add(sides[1])[0]
        roots[name] = ring
    return roots


def _root_stations(name: str) -> np.ndarray:
    """Station of each vertex of a root ring: slanted at the thumb, further out in the webs of the others."""
    if name == "thumb":
        return 0.71 - 0.09 * np.cos(2 * np.pi * np.arange(RING) / RING)
    stations = np.full(RING, 0.50)
    stations[list(_BACK)], stations[list(_FRONT)] = 0.36, 0.46
    return stations


def _web_point(one: str, other: str) -> np.ndarray:
    """Deepest point of the web between two fingers: where a ray from the palm leaves the surface."""
    start = (PROFILES[one].center(0.0) + PROFILES[other].center(0.0)) / 2
    ahead = PROFILES[one].direction(0.3) + PROFILES[other].direction(0.3)
    ray = start + np.linspace(0.0, 45.0, 451)[:, None] * ahead / np.linalg.norm(ahead)
    return ray[np.argmax(distance(ray) > 0)]


def _wrist_loop(build: _Builder) -> np.ndarray:
    angles = 2 * np.pi * np.arange(WRIST_RING) / WRIST_RING
    spokes = np.stack([np.zeros(WRIST_RING), np.cos(angles), np.sin(angles)], axis=-1)
    center = np.array([_WRIST_U, -1.0, -2.0])
    reach = np.linspace(8.0, 45.0, 371)
    within = distance(center + reach[:, None, None] * spokes) < 0
    return build.add(center + (reach[:, None] * within).max(axis=0)[:, None] * spokes)


def _outline(build: _Builder, start: int, stop: int, count: int) -> np.ndarray:
    """Vertices along the side of the palm between two given ones: its silhouette from above."""
    a, b = build.points[start], build.points[stop]
    t = np.arange(1, count + 1)[:, None] / (count + 1)
    along = b - a
    # Both sides are walked with the palm on the right.
    out = np.array([-along[1], along[0], 0.0]) / np.linalg.norm(along[:2])
    reach, rise = np.meshgrid(np.arange(-25.0, 25.0, 0.25), np.arange(-14.0, 14.0, 0.5), indexing="ij")
    search = (a + t * along)[:, None, None] + reach[..., None] * out + rise[..., None] * np.array([0.0, 0, 1])
    within = distance(search) < 0
    # From within the palm outwards, the last step before the skin is left.
    exits = (~within.any(axis=2)).argmax(axis=1) - 1
    return build.add(np.array([search[k, i, within[k, i]].mean(axis=0) for k, i in enumerate(exits)]))


def _sheet(build: _Builder, outline: np.ndarray, count: int, sign: float, rng) -> None:
    """Fill an outline by a triangulated sheet on the back (sign +1) or the palm (-1) of the surface."""
    polygon = np.array([build.points[i][:2] for i in outline])
    flat = scatter(polygon, count, rng)
    heights = np.arange(-60.0, 40.0, 0.25)
    columns = np.concatenate(
        [
            np.repeat(flat[:, None], len(heights), 1),
            np.broadcast_to(heights[:, None], (count, len(heights), 1)),
        ],
        axis=-1,
    )
    within = distance(columns) < 0
    assert within.any(axis=1).all(), "the outline must lie over the hand"
    height = sign * np.where(within, sign * heights, -np.inf).max(axis=1)
    inner = build.add(np.column_stack([flat, height]))
    numbers = np.concatenate([outline, inner])
    plane = np.vstack([polygon, flat])
    triangles = Delaunay(plane).simplices
    triangles = triangles[inside(polygon, plane[triangles].mean(axis=1))]
    build.faces += [tuple(numbers[t]) for t in triangles]


def neighbour_matrix(faces: np.ndarray, count: int) -> np.ndarray:
    """Row-normalised adjacency."""
    a = np.zeros((count, count))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        a[faces[:, i], faces[:, j]] = a[faces[:, j], faces[:, i]] = 1.0
    return a / a.sum(axis=1, keepdims=True)


def build_mesh(seed: int = 2) -> Mesh:
    """Make the mesh of the resting hand; the seed scatters the palm's vertices (2 creases best of 0..6)."""
    rng = np.random.default_rng(seed)
    build = _Builder()
    rings, stations, tips = _finger_tubes(build)
    fixed = len(build.points)
    roots = _root_rings(build)
    for name in FINGERS:
        build.strip(roots[name], rings[name][0])
    wrist = _wrist_loop(build)
    radial = _outline(build, wrist[0], roots["thumb"][0], 6)
    web = build.add(np.array(_THUMB_WEB))
    ulnar = _outline(build, roots["little"][5], wrist[8], 9)

    def outline(side: tuple[int, ...], wrist_half: np.ndarray) -> np.ndarray:
        thumb = roots["thumb"]
        parts = [wrist[:1], radial, thumb[[0, *side, 5]], web, roots["index"][[0, *side, 5]]]
        parts += [roots[name][[*side, 5]] for name in FINGERS[2:]]
        return np.concatenate([*parts, ulnar, wrist[8:9], wrist_half])

    back, front = outline(_BACK, wrist[7:0:-1]), outline(_FRONT, wrist[9:16])
    left = NUM_VERTICES - len(build.points)
    tube_faces = len(build.faces)
    _sheet(build, back, left // 2, 1.0, rng)
    _sheet(build, front, left - left // 2, -1.0, rng)
    faces = oriented(np.array(build.faces))
    vertices = np.array(build.points)
    all_rings = {name: np.stack([roots[name], *rings[name]]) for name in FINGERS}
    mesh = Mesh(vertices, faces, all_rings, stations, tips, wrist)
    free = np.arange(NUM_VERTICES) >= fixed
    free[wrist] = False
    free[np.concatenate([radial, web, ulnar, *roots.values()])] = False
    sheet_faces = np.arange(len(faces)) >= tube_faces
    for _ in range(3):
        mesh = mesh._replace(vertices=_relaxed(mesh, free))
        mesh = mesh._replace(faces=flipped(mesh.vertices, mesh.faces, sheet_faces))
    return mesh


def _relaxed(mesh: Mesh, free: np.ndarray, rounds: int = 15) -> np.ndarray:
    """Even out the free vertices on the surface."""
    average = neighbour_matrix(mesh.faces, len(mesh.vertices))
    v = mesh.vertices.copy()
    for _ in range(rounds):
        v[free] += 0.5 * (average @ v - v)[free]
        v[free] = project(v[free], steps=2)
    return v
