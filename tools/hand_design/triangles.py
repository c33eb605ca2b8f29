"""Plane and surface triangulation: even scattering in a polygon, orientation, edge flips."""

import numpy as np


def inside(polygon: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Even-odd rule for points (n, 2)."""
    a, b = polygon[:, None], np.roll(polygon, -1, axis=0)[:, None]
    crosses = (a[..., 1] > p[:, 1]) != (b[..., 1] > p[:, 1])
    rise = np.where(crosses, b[..., 1] - a[..., 1], 1.0)
    x = a[..., 0] + (p[:, 1] - a[..., 1]) / rise * (b[..., 0] - a[..., 0])
    return (crosses & (p[:, 0] < x)).sum(axis=0) % 2 == 1


def scatter(polygon: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Spread points evenly in a polygon (Lloyd's iteration; the outline holds cells of its own)."""
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, 1.0) for a, b in zip(low, high, strict=True))), -1)
    grid = grid.reshape(-1, 2)
    grid = grid[inside(polygon, grid)]
    points = grid[rng.choice(len(grid), count, replace=False)]
    for _ in range(80):
        centers = np.vstack([points, polygon, (polygon + np.roll(polygon, 1, axis=0)) / 2])
        nearest = ((grid[:, None] - centers[None]) ** 2).sum(-1).argmin(axis=1)
        for k in range(count):
            cell = grid[nearest == k]
            if len(cell):
                points[k] = cell.mean(axis=0)
    return points


def oriented(faces: np.ndarray) -> np.ndarray:
    """Turn the faces to agree with their neighbours, starting from the first."""
    faces = faces.copy()
    by_edge: dict[tuple[int, int], list[int]] = {}
    for f, face in enumerate(faces):
        for k in range(3):
            by_edge.setdefault(tuple(sorted((face[k], face[(k + 1) % 3]))), []).append(f)
    done, queue = np.zeros(len(faces), bool), [0]
    done[0] = True
    while queue:
        face = faces[f := queue.pop()]
        for k in range(3):
            a, b = face[k], face[(k + 1) % 3]
            for g in by_edge[tuple(sorted((a, b)))]:
                if done[g]:
                    continue
                if any(faces[g][i] == a and faces[g][(i + 1) % 3] == b for i in range(3)):
                    faces[g] = faces[g][::-1]
                done[g] = True
                queue.append(g)
    assert done.all(), "the mesh must be one piece"
    return faces


def flipped(vertices: np.ndarray, faces: np.ndarray, flippable: np.ndarray, passes: int = 6) -> np.ndarray:
    """Flip edges of the sheets until they are Delaunay on the surface."""
    faces = faces.copy()
    for _ in range(passes):
        by_edge: dict[tuple[int, int], list[int]] = {}
        for f, face in enumerate(faces):
            for k in range(3):
                by_edge.setdefault(tuple(sorted((int(face[k]), int(face[(k + 1) % 3])))), []).append(f)
        touched: set[int] = set()
        for (a, b), pair in list(by_edge.items()):
            if len(pair) != 2 or touched & set(pair) or not (flippable[pair[0]] and flippable[pair[1]]):
                continue
            f, g = pair
            if not any(faces[f][k] == a and faces[f][(k + 1) % 3] == b for k in range(3)):
                f, g = g, f
            c, d = (int(next(i for i in faces[h] if i not in (a, b))) for h in (f, g))
            if tuple(sorted((c, d))) in by_edge:
                continue
            if _angle(vertices, c, a, b) + _angle(vertices, d, a, b) > np.pi + 0.02:
                faces[f], faces[g] = (a, d, c), (d, b, c)
                touched |= {f, g}
                by_edge[tuple(sorted((c, d)))] = [f, g]
        if not touched:
            break
    return faces


def _angle(v: np.ndarray, corner: int, a: int, b: int) -> float:
    """Angle at `corner` between the directions to `a` and `b`."""
    p, q = v[a] - v[corner], v[b] - v[corner]
    return float(np.arctan2(np.linalg.norm(np.cross(p, q)), p @ q))
