"""Ten shape directions that mean something: each scales some bones along, across or through (one sd per
unit).

The scales act through the skin weights, as bends do, so that every direction is smooth and joints move
along. Standard deviations follow adult surveys (both sexes pooled): hand length about 5.5 %, finger
breadths about 6 %.
"""

import numpy as np
from hand_design.anatomy import FINGERS, SKELETON
from hand_design.skin import MANO_FINGERS, NUM_BONES, first_bone, skeleton

ALONG, ACROSS, THROUGH = 0, 1, 2
_LONG_FINGERS = FINGERS[1:]
Scales = np.ndarray
"""(16, 3) relative change of each bone along its axis, across it and through the hand's thickness."""


def _bones(*names: str) -> list[int]:
    return [first_bone(name) + k for name in names for k in range(3)]


def _blank() -> Scales:
    return np.zeros((NUM_BONES, 3))


def _size() -> Scales:
    return _blank() + 0.05


def _girth() -> Scales:
    s = _blank()
    s[_bones(*_LONG_FINGERS), ACROSS:] = 0.05
    return s


def _thumb_girth() -> Scales:
    s = _blank()
    s[_bones("thumb")[1:], ACROSS:] = 0.06
    s[first_bone("thumb"), ACROSS:] = 0.02
    return s


def _slenderness() -> Scales:
    s = _blank() - 0.04
    s[:, ALONG] = 0.005
    return s


def _finger_proportion() -> Scales:
    s = _blank()
    s[_bones(*_LONG_FINGERS), ALONG] = 0.045
    s[0, ALONG] = -0.02
    return s


def _thumb_length() -> Scales:
    s = _blank()
    s[_bones("thumb"), ALONG] = 0.05
    return s


def _palm_thickness() -> Scales:
    s = _blank()
    s[0, THROUGH] = 0.06
    s[first_bone("thumb"), ACROSS:] = 0.05
    return s


def _finger_taper() -> Scales:
    s = _blank()
    for name in FINGERS:
        s[_bones(name), ACROSS:] = np.array([0.03, -0.01, -0.05])[:, None]
    s[first_bone("thumb")] = 0.0
    return s


def _radial_fingers() -> Scales:
    s = _blank()
    for name, change in (("index", 0.035), ("middle", 0.01), ("ring", -0.02), ("little", -0.035)):
        s[_bones(name), ALONG] = change
    return s


def _end_segments() -> Scales:
    s = _blank()
    for name in _LONG_FINGERS:
        s[_bones(name), ALONG] = (-0.025, 0.0, 0.052)
    s[_bones("thumb")[1:], ALONG] = (-0.03, 0.035)
    return s


DIRECTIONS = {
    "size": _size,
    "girth": _girth,
    "slenderness": _slenderness,
    "finger_proportion": _finger_proportion,
    "palm_thickness": _palm_thickness,
    "thumb_length": _thumb_length,
    "thumb_girth": _thumb_girth,
    "finger_taper": _finger_taper,
    "radial_fingers": _radial_fingers,
    "end_segments": _end_segments,
}


def _frames() -> np.ndarray:
    """(16, 3, 3): rows are each bone's axis, lateral and dorsal directions."""
    frames = np.zeros((NUM_BONES, 3, 3))
    frames[0] = np.eye(3)
    for name in MANO_FINGERS:
        finger = SKELETON[name]
        for k in range(3):
            axis = finger.joints[k + 1] - finger.joints[k]
            axis /= np.linalg.norm(axis)
            dorsal = finger.dorsal - axis * (finger.dorsal @ axis)
            dorsal /= np.linalg.norm(dorsal)
            frames[first_bone(name) + k] = axis, np.cross(dorsal, axis), dorsal
    return frames


def _offsets(v: np.ndarray, weights: np.ndarray, scales: Scales) -> np.ndarray:
    """First-order displacement of the vertices, (778, 3)."""
    joints, frames = skeleton(), _frames()
    stretch = np.einsum("jki,jk,jkl->jil", frames, scales, frames)
    moved = np.zeros_like(joints)
    for name in MANO_FINGERS:
        parent = 0
        for k in range(3):
            j = first_bone(name) + k
            moved[j] = moved[parent] + stretch[parent] @ (joints[j] - joints[parent])
            parent = j
    local = np.einsum("jil,vjl->vji", stretch, v[:, None] - joints)
    return np.einsum("vj,vji->vi", weights, moved + local)


def shape_directions(v: np.ndarray, broad_weights: np.ndarray) -> np.ndarray:
    """(778, 3, 10) in millimetres of the design frame."""
    return np.stack([_offsets(v, broad_weights, make()) for make in DIRECTIONS.values()], axis=-1)
