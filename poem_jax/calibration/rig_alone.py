"""What a rig shows by itself, without any key points: cameras that stand twice or look at nothing together,
focal lengths that no lens has, a unit by which no room is so large.

All but cameras that stand twice are doubts: key points that fit together take them back.
"""

from itertools import combinations

import numpy as np

from poem_jax.calibration.findings import Finding
from poem_jax.calibration.mistakes import HYPOTHESES
from poem_jax.calibration.units import EXTENT_M
from poem_jax.geometry.cameras import project
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.typing import Array, Float

DUPLICATE = "duplicate cameras"
"""Name of the finding that key points do not take back."""

_SAME_SHARE = 1e-3
"""Of the rig's extent: centres nearer to each other, of cameras that look the same way, are of one camera."""
_SAME_TURN = np.radians(0.2)
_MAX_RATIO = 1.25
"""Of fx and fy: pixels are square, or nearly so."""
_FIELDS_DEG = (3.0, 150.0)
"""Full angles that a pinhole lens is believed to show along the width."""
_PARALLEL_DEG = 12.0
"""Cameras whose axes differ by less may look past each other."""
_MARGIN = 0.25
"""Of an image's size, by which the common point may lie outside."""


def judge_rig(rig: Rig) -> list[Finding]:
    """Say what a rig alone gives cause to doubt; [] = nothing. What is certain comes first."""
    return [*_duplicates(rig), *_directions(rig), *_focal_lengths(rig), *_lengths(rig)]


def _duplicates(rig: Rig) -> list[Finding]:
    centres, R = _centres(rig), rig.T_cam_from_world[:, :3, :3]
    extent = np.linalg.norm(centres - centres.mean(0), axis=-1).max()
    found = []
    for a, b in combinations(range(rig.num_views), 2):
        apart = float(np.linalg.norm(centres[a] - centres[b]))
        turn = np.arccos(np.clip((np.trace(R[a] @ R[b].T) - 1) / 2, -1, 1))
        if apart <= _SAME_SHARE * extent and turn < _SAME_TURN:
            evidence = (
                f"cameras '{rig.names[a]}' and '{rig.names[b]}' stand at one place and look the same way "
                f"({1000 * apart:.2g} mm and {np.degrees(turn):.2g} degrees apart)"
            )
            found.append(Finding(DUPLICATE, evidence, "list a camera once, or correct one of the two"))
    return found


def _directions(rig: Rig) -> list[Finding]:
    """Doubt extrinsics whose optical axes do not meet before the cameras."""
    if rig.num_views < 2 or _widest_angle(rig) < _PARALLEL_DEG or _sees_together(rig).all():
        return []
    blind = [f"'{name}'" for name, sees in zip(rig.names, _sees_together(rig), strict=True) if not sees]
    nothing = np.full((1, 1, rig.num_views, 1, 2), np.nan)
    better = [m for m in HYPOTHESES if _sees_together(m.undo(rig, nothing)[0]).all()]
    evidence = (
        "the cameras do not look at one place: the point nearest to all their optical axes is not in the "
        f"image of {', '.join(blind)}"
    )
    if better:
        evidence += f"; it would be if {better[0].cause}"
    fix = better[0].fix if better else "check that x_cam = R @ x_world + t in OpenCV axes"
    return [Finding("cameras look apart", evidence, fix)]


def _focal_lengths(rig: Rig) -> list[Finding]:
    found = []
    for name, (width, _), K in zip(rig.names, rig.size_wh, rig.K, strict=True):
        fx, fy = K[0, 0], K[1, 1]
        field = np.degrees(2 * np.arctan(0.5 * width / fx))
        if max(fx / fy, fy / fx) > _MAX_RATIO:
            evidence = f"the pixels of camera '{name}' are not square: fx = {fx:.0f}, fy = {fy:.0f}"
            found.append(Finding("focal lengths", evidence, "check fx and fy of `K`"))
        elif not _FIELDS_DEG[0] < field < _FIELDS_DEG[1]:
            evidence = (
                f"camera '{name}' sees {field:.0f} degrees over its {width} pixels (fx = {fx:.0f}), which no "
                "pinhole lens does"
            )
            found.append(Finding("focal lengths", evidence, "check fx of `K`, and that it is in pixels"))
    return found


def _lengths(rig: Rig) -> list[Finding]:
    if rig.num_views < 2:
        return []
    centres = _centres(rig)
    pairs = [np.linalg.norm(centres[a] - centres[b]) for a, b in combinations(range(rig.num_views), 2)]
    widest, nearest = float(max(pairs)), int(np.argmin(pairs))
    if not EXTENT_M[0] <= widest <= EXTENT_M[1]:
        evidence = f"the cameras stand up to {widest:.3g} m apart, which is not the size of a rig for hands"
        fix = f"check the unit: in millimetres it would be {widest / 1000:.3g} m"
        return [Finding("unit of the rig", evidence, fix if widest > EXTENT_M[1] else "check the unit")]
    a, b = list(combinations(range(rig.num_views), 2))[nearest]
    if pairs[nearest] < 0.01 * widest and not _duplicates(rig):
        evidence = (
            f"cameras '{rig.names[a]}' and '{rig.names[b]}' stand {1000 * pairs[nearest]:.1f} mm apart, so "
            "that the two measure no depth"
        )
        return [Finding("no baseline", evidence, "move one of them, or check `t`")]
    return []


def _centres(rig: Rig) -> Float[Array, "view 3"]:
    return invert_rigid(np.asarray(rig.T_cam_from_world, np.float64))[:, :3, 3]


def _widest_angle(rig: Rig) -> float:
    """Return the largest angle between two optical axes, degrees."""
    axes = rig.T_cam_from_world[:, 2, :3]
    return float(np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)).max()))


def _sees_together(rig: Rig) -> Array:
    """Tell which cameras show the point nearest to all optical axes, or nearly so."""
    axes, centres = rig.T_cam_from_world[:, 2, :3], _centres(rig)
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    point = np.linalg.lstsq(across.sum(0), np.einsum("vij,vj->i", across, centres), rcond=None)[0]
    uv, depth = project(rig.K, rig.T_cam_from_world, point[None, None])
    low, high = -_MARGIN * rig.size_wh, (1 + _MARGIN) * rig.size_wh
    return (depth[:, 0] > 0) & ((uv[:, 0] > low) & (uv[:, 0] < high)).all(-1)
