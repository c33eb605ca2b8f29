"""Measures of the shipped hand: where its joints lie and how broad and deep its fingers are.

Design frame, used by all files of this folder: millimetres, axes (distal, radial, dorsal) = (u, w, h) of a
right hand, origin at the wrist joint. `to_mano_axes` turns it into the axes and metres of the shipped file.

Bone lengths: Buryanov & Kotiuk, "Proportions of hand segments", Int. J. Morphol. 28(3), 2010, tables of
phalanges and of distal soft tissue (means of 66 adults).
"""

from typing import NamedTuple

import numpy as np

FINGERS = ("thumb", "index", "middle", "ring", "little")
WRIST_X_M = 0.095
"""Where MANO's right template has its wrist on the x axis."""


class Finger(NamedTuple):
    """One finger at rest."""

    joints: np.ndarray
    """(4, 3): MCP, PIP, DIP, tip; CMC, MCP, IP, tip of the thumb."""
    lateral: np.ndarray
    """(3,) unit vector towards the radial side of the finger; flexion turns about it."""
    dorsal: np.ndarray
    """(3,) unit vector towards the nail's side."""


PHALANGES = {
    "thumb": (46.2, 31.6, 21.7 + 5.7),
    "index": (39.8, 22.4, 15.8 + 3.8),
    "middle": (44.6, 26.3, 17.4 + 4.0),
    "ring": (41.4, 25.7, 17.3 + 4.0),
    "little": (32.7, 18.1, 16.0 + 3.7),
}
"""Lengths of the three segments of each finger; the last reaches to the skin, the thumb's first is its
metacarpal."""

_ROOTS = {
    "thumb": (20.0, 21.0, -9.0),
    "index": (88.0, 24.5, 0.5),
    "middle": (91.0, 3.0, 2.5),
    "ring": (84.0, -17.3, 1.0),
    "little": (73.5, -35.0, -3.5),
}
_SPREAD_DEG = {"index": 6.0, "middle": 1.0, "ring": -5.0, "little": -13.0}
_DROOP_DEG = (1.0, 4.0, 6.0)
_THUMB_DIRECTIONS = ((0.74, 0.65, -0.17), (0.82, 0.55, -0.16), (0.90, 0.42, -0.11))
_THUMB_DORSAL = (-0.35, 0.62, 0.70)


def _unit(vector) -> np.ndarray:
    vector = np.asarray(vector, float)
    return vector / np.linalg.norm(vector)


def _finger(name: str) -> Finger:
    if name == "thumb":
        directions = [_unit(d) for d in _THUMB_DIRECTIONS]
        dorsal = np.asarray(_THUMB_DORSAL)
    else:
        spread = np.deg2rad(_SPREAD_DEG[name])
        ahead = np.array([np.cos(spread), np.sin(spread), 0.0])
        directions = [
            np.cos(a) * ahead - np.sin(a) * np.array([0.0, 0.0, 1.0]) for a in np.deg2rad(_DROOP_DEG)
        ]
        dorsal = np.array([0.0, 0.0, 1.0])
    steps = [length * d for length, d in zip(PHALANGES[name], directions, strict=True)]
    joints = np.asarray(_ROOTS[name]) + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    axis = directions[1]
    dorsal = _unit(dorsal - axis * (dorsal @ axis))
    # (u, w, h) of a right hand is a left-handed system: numbers of a cross product come out as the radial
    # side.
    return Finger(joints, np.cross(dorsal, axis), dorsal)


SKELETON = {name: _finger(name) for name in FINGERS}


def to_mano_axes(points: np.ndarray) -> np.ndarray:
    """(u, w, h) in millimetres -> MANO's x, y, z in metres."""
    u, w, h = np.moveaxis(np.asarray(points, float) * 1e-3, -1, 0)
    return np.stack([WRIST_X_M - u, h, w], axis=-1)


def vectors_to_mano_axes(vectors: np.ndarray) -> np.ndarray:
    """(u, w, h) -> x, y, z of directions, without scale."""
    u, w, h = np.moveaxis(np.asarray(vectors, float), -1, 0)
    return np.stack([-u, h, w], axis=-1)
