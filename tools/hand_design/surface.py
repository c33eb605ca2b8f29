"""The skin as an implicit surface: a smooth union of cones and ellipsoids around the skeleton (design
frame, mm).

`distance(p)` is negative inside. It is close to a true distance near the surface, which is all that
projecting a vertex on to it needs.
"""

from itertools import pairwise

import numpy as np
from hand_design.anatomy import FINGERS, SKELETON, Finger
from scipy.interpolate import PchipInterpolator

_PALM_BLEND_MM, _WEB_BLEND_MM = 3.2, 1.8
"""Widths of the smooth unions: within the palm, and where fingers leave it."""

# Stations along a finger from its first joint to the tip, in units of its segments (0 = MCP, 1 = PIP, 2 =
# DIP, 3 = tip; for the thumb CMC, MCP, IP, tip), with breadth and depth there in millimetres.
_STATIONS = (0.0, 0.5, 0.75, 1.0, 1.5, 2.0, 2.45, 3.0)
_BREADTH = {
    "index": (20.0, 19.0, 18.2, 19.2, 17.2, 16.8, 16.6, 15.4),
    "middle": (20.0, 19.2, 18.4, 19.5, 17.5, 17.0, 16.9, 15.8),
    "ring": (19.0, 18.0, 17.2, 18.2, 16.4, 16.0, 15.8, 14.8),
    "little": (16.8, 15.9, 15.2, 16.0, 14.5, 14.2, 13.9, 13.0),
}
_DEPTH = {
    "index": (23.0, 20.0, 18.6, 18.4, 16.0, 14.6, 13.8, 11.6),
    "middle": (23.0, 20.4, 19.0, 18.9, 16.5, 15.0, 14.2, 12.0),
    "ring": (22.0, 19.4, 17.9, 17.7, 15.5, 14.2, 13.4, 11.2),
    "little": (20.0, 17.2, 16.0, 15.8, 13.9, 12.8, 12.1, 10.2),
}
_THUMB_STATIONS = (0.0, 0.6, 0.85, 1.0, 1.5, 2.0, 2.45, 3.0)
_THUMB_BREADTH = (24.0, 24.0, 23.0, 22.5, 19.6, 21.0, 21.2, 19.0)
_THUMB_DEPTH = (28.0, 25.0, 22.5, 21.5, 18.6, 18.2, 16.4, 12.5)


class Profile:
    """Axis, breadth and depth of one finger along its length."""

    def __init__(self, name: str):
        thumb = name == "thumb"
        stations = _THUMB_STATIONS if thumb else _STATIONS
        self.finger: Finger = SKELETON[name]
        self.breadth = PchipInterpolator(stations, _THUMB_BREADTH if thumb else _BREADTH[name])
        self.depth = PchipInterpolator(stations, _THUMB_DEPTH if thumb else _DEPTH[name])

    def center(self, station) -> np.ndarray:
        """Point of the axis."""
        return np.stack([np.interp(station, np.arange(4.0), self.finger.joints[:, k]) for k in range(3)], -1)

    def direction(self, station: float) -> np.ndarray:
        """Unit tangent; at a joint the mean of its two segments."""
        ahead = self.center(min(station + 0.2, 3.0)) - self.center(max(station - 0.2, 0.0))
        return ahead / np.linalg.norm(ahead)

    def radius(self, station, cos, sin) -> np.ndarray:
        """Distance from axis to skin towards (cos, sin): (1, 0) = radial side, (0, 1) = dorsal."""
        a, b = self.breadth(station) / 2, self.depth(station) / 2
        # Pads are fuller than the back of the finger.
        b = b * np.where(sin > 0, 0.96, 1.04)
        power = 2.25
        return _cap(station) * (np.abs(cos / a) ** power + np.abs(sin / b) ** power) ** (-1 / power)

    def distance(self, p: np.ndarray, start: float, stop: float) -> np.ndarray:
        """Signed distance (about) to the stretch of the finger between two stations."""
        best = np.full(p.shape[:-1], np.inf)
        for first in range(int(np.ceil(stop))):
            low, high = max(start, first), min(stop, first + 1)
            a, b = self.finger.joints[first : first + 2]
            t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)) + first, low, high)
            offset = p - self.center(t)
            length = np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
            lateral, dorsal = self._frame((b - a) / np.linalg.norm(b - a))
            cos, sin = offset @ lateral / length, offset @ dorsal / length
            planar = np.maximum(np.hypot(cos, sin), 1e-9)
            best = np.minimum(best, length - self.radius(t, cos / planar, sin / planar))
        return best

    def _frame(self, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        dorsal = self.finger.dorsal - axis * (self.finger.dorsal @ axis)
        dorsal = dorsal / np.linalg.norm(dorsal)
        return np.cross(dorsal, axis), dorsal

    def angle(self, axis: np.ndarray, spokes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cosine and sine, about the finger's own frame, of directions square to `axis`."""
        lateral, dorsal = self._frame(axis)
        return spokes @ lateral, spokes @ dorsal


def _cap(station) -> np.ndarray:
    """Shrink the last stretch into a rounded tip."""
    start = 2.45
    x = np.clip((np.asarray(station, float) - start) / (3.0 - start), 0.0, 1.0)
    return (1 - x**2.7) ** (1 / 2.2)


PROFILES = {name: Profile(name) for name in FINGERS}


def cone(p, a, b, ra, rb):
    """Capsule whose radius changes linearly from `ra` at `a` to `rb` at `b`."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    t = np.clip(((p - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1) - (ra + t * (rb - ra))


def ellipsoid(p, center, radii, axis=(1.0, 0.0, 0.0)):
    """Ellipsoid with its first radius along `axis`, the third near the dorsal direction."""
    first = np.asarray(axis, float) / np.linalg.norm(axis)
    second = np.cross([0.0, 0.0, 1.0], first)
    second /= np.linalg.norm(second)
    frame = np.stack([first, second, np.cross(first, second)])
    q = (p - np.asarray(center, float)) @ frame.T
    radii = np.asarray(radii, float)
    k0 = np.linalg.norm(q / radii, axis=-1)
    k1 = np.linalg.norm(q / radii**2, axis=-1)
    return k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)


def _palm_parts(p):
    for name, carpal, r0, r1 in (
        ("index", (14, 9, 0), 11.8, 11.2),
        ("middle", (12, 2, 1), 11.8, 11.2),
        ("ring", (12, -6, 0.5), 11.8, 10.9),
        ("little", (14, -12, -2), 11.8, 9.9),
    ):
        root = SKELETON[name].joints[0]
        yield cone(p, carpal, root + np.array([0, 0, -2.0]), r0, r1)
        # The pad at the root of the finger on the palm's side, and the knuckle.
        width = float(PROFILES[name].breadth(0.0)) / 2
        yield ellipsoid(p, root + np.array([7.0, 0, -6.0]), (12, width - 1.5, 7.5))
        yield ellipsoid(p, root + np.array([-1.0, 0, 3.5]), (13, width - 3.0, 7.0))
    for one, other in pairwise(FINGERS[1:]):
        ends = [PROFILES[name].center(0.27) + np.array([0, 0, -1.5]) for name in (one, other)]
        yield cone(p, ends[0], ends[1], 5.0, 5.0)
    thumb = SKELETON["thumb"].joints
    yield ellipsoid(p, (37, 23, -12.5), (30, 13.5, 13.0), axis=(0.85, 0.52, -0.05))
    yield ellipsoid(p, (34, -22.5, -8.5), (40, 12.0, 13.0), axis=(1.0, -0.2, 0.05))
    yield cone(p, thumb[0], thumb[1], 10.5, 10.5)
    yield cone(p, (51, 33, -10.5), (82, 26.5, -4.5), 5.0, 8.0)
    yield ellipsoid(p, (-40, -1.0, -2.0), (95, 28.5, 18.5))


def _smooth_union(parts, width: float) -> np.ndarray:
    """Union whose seams are rounded over about `width` (log-sum-exp)."""
    parts = np.stack(list(parts))
    low = parts.min(axis=0)
    return low - width * np.log(np.exp(-(parts - low) / width).sum(axis=0))


def distance(p: np.ndarray) -> np.ndarray:
    """Signed distance (about), (..., 3) mm -> (...) mm."""
    p = np.asarray(p, float)
    fingers = [PROFILES[n].distance(p, 0.45 if n == "thumb" else 0.15, 1.6) for n in FINGERS]
    palm = _smooth_union(_palm_parts(p), _PALM_BLEND_MM)
    return _smooth_union([np.min(fingers, axis=0), palm], _WEB_BLEND_MM)


def gradient(p: np.ndarray, step: float = 0.05) -> np.ndarray:
    """Outward direction, unit length."""
    shifts = step * np.eye(3)
    g = np.stack([distance(p + s) - distance(p - s) for s in shifts], axis=-1) / (2 * step)
    return g / np.maximum(np.linalg.norm(g, axis=-1, keepdims=True), 1e-9)


def project(p: np.ndarray, steps: int = 4) -> np.ndarray:
    """Move points on to the surface."""
    for _ in range(steps):
        p = p - distance(p)[..., None] * gradient(p)
    return p
