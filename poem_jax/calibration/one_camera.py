"""What is wrong with the one camera that stands alone: a known mistake, or it was moved.

The others say where the joints are; the camera must show them there. A known mistake has nothing to be
estimated, while a new place of the camera has six numbers and explains nearly everything: so the mistake is
named where it does nearly as well.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.calibration.findings import Finding
from poem_jax.calibration.meeting_points import meeting_points, near_rig
from poem_jax.calibration.mistakes import HYPOTHESES
from poem_jax.geometry.cameras import project
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle
from poem_jax.typing import Array, Float

MOVED = "camera moved"
"""Name of the finding of a camera at another place or turned."""

_MIN_POINTS = 40
_MAX_POINTS = 400
_CLEAR = 0.6
"""So much of the next mistake's error, at most, may remain with the best one."""
_KNOWN_IS_ENOUGH = 1.5
"""A mistake is named where it leaves so much more than the best place of the camera, at most."""
_TURN_IS_ENOUGH = 1.15
_MIN_GAIN = 0.6


class LoneCamera(NamedTuple):
    """Why a camera does not show what the others show."""

    finding: Finding
    rig: Rig
    """With the camera as it should be, where it was moved; else as given."""
    known: bool
    """Whether the cause is a known mistake with nothing estimated."""


class _Scene(NamedTuple):
    """What the others say, in the rig's near frame."""

    rig: Rig
    extent: float
    view: int
    points: Float[Array, "point 3"]
    ideal_px: Float[Array, "point 2"]
    scale_px: float
    """Noise of a key point, about."""


def explain_camera(
    rig: Rig, keypoints_px: Float[Array, "frame hand view joint 2"], view: int, limit_px: float
) -> LoneCamera | None:
    """Say why one camera does not show what the others, which agree, show.

    Args:
        rig: The cameras, three at least.
        keypoints_px: In pixels of the raw images; NaN = unseen.
        view: The camera.
        limit_px: What counts as noise.

    Returns: None where no cause is clear: the camera shows something else at all.
    """
    near, extent = near_rig(rig)
    flat = keypoints_px.reshape(-1, *keypoints_px.shape[2:])
    others = ideal_keypoints(near, keypoints_px).reshape(flat.shape).copy()
    others[:, view] = np.nan
    points, valid = meeting_points(near, others)
    picked = valid & np.isfinite(flat[:, view]).all(-1)
    if picked.sum() < _MIN_POINTS:
        return None
    order = np.flatnonzero(picked.ravel())
    order = order[np.unique(np.linspace(0, len(order) - 1, min(len(order), _MAX_POINTS)).astype(int))]
    raw = flat[:, view].reshape(-1, 2)[order]
    points = points.reshape(-1, 3)[order]
    scene = _Scene(near, extent, view, points, _ideal(near, view, raw), limit_px)
    given = _error_px(scene, near.K[view], near.T_cam_from_world[view], scene.ideal_px)
    turned, moved = _turned(scene), _moved(scene)
    floor = _error_px(scene, near.K[view], moved, scene.ideal_px)
    most = float(np.clip(_KNOWN_IS_ENOUGH * floor, 0.5 * limit_px, 2 * limit_px))
    known = _known_mistake(rig, scene, raw, most)
    if known is not None:
        return LoneCamera(known, rig, True)
    if floor > _MIN_GAIN * given or floor > 2 * limit_px:
        return None
    turn_px = _error_px(scene, near.K[view], turned, scene.ideal_px)
    is_turned = turn_px <= _TURN_IS_ENOUGH * floor
    new = turned if is_turned else moved
    T = rig.T_cam_from_world.copy()
    T[view] = _in_world(scene, rig, new)
    finding = _moved_finding(rig, T, view, given, turn_px if is_turned else floor, is_turned)
    return LoneCamera(finding, rig._replace(T_cam_from_world=T), False)


def _known_mistake(rig: Rig, scene: _Scene, raw: Array, limit_px: float) -> Finding | None:
    """Return the mistake that makes the camera show the points, if one does clearly better than the rest."""
    errors = []
    for mistake in HYPOTHESES:
        uv = np.full((1, 1, rig.num_views, len(raw), 2), np.nan)
        uv[0, 0, scene.view] = raw
        undone, uv = mistake.undo(rig, uv)
        T = rig.T_cam_from_world.copy()
        T[scene.view] = undone.T_cam_from_world[scene.view]
        own = rig._replace(K=undone.K)
        ideal = _ideal(own, scene.view, uv[0, 0, scene.view])
        errors.append(_error_px(scene, own.K[scene.view], _in_near(scene, rig, T[scene.view]), ideal))
    best, second = np.argsort(errors)[:2]
    if errors[best] > limit_px or errors[best] > _CLEAR * errors[second]:
        return None
    mistake = HYPOTHESES[best]
    evidence = (
        f"of camera '{rig.names[scene.view]}' alone it seems that {mistake.cause}: so it shows the joints "
        f"{errors[best]:.1f} px from where the other cameras place them (median)"
    )
    fix = f"for '{rig.names[scene.view]}' {mistake.fix}"
    return Finding(mistake.name, evidence, fix, fatal=False)


def _moved_finding(rig: Rig, T: Array, view: int, given: float, found: float, turned: bool) -> Finding:
    turn = T[view, :3, :3] @ rig.T_cam_from_world[view, :3, :3].T
    degrees = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    centres = invert_rigid(np.stack([T[view], rig.T_cam_from_world[view]]))[:, :3, 3]
    millimetres = 1000 * float(np.linalg.norm(centres[0] - centres[1]))
    how = f"turned by {degrees:.1f} degrees"
    how = how if turned else f"{how} and moved by {millimetres:.0f} mm"
    evidence = (
        f"camera '{rig.names[view]}' alone does not show what the others agree on: it would fit them {how} "
        f"({found:.1f} px then, {given:.0f} px as given, median)"
    )
    evidence += "; a wrong principal point would look the same" if turned else ""
    return Finding(
        MOVED,
        evidence,
        f"calibrate '{rig.names[view]}' anew, leave it out, or let `poem calibration refine` place it",
        fatal=False,
    )


def _turned(scene: _Scene) -> Float[Array, "4 4"]:
    """Return the extrinsics that fit best of those at the camera's place."""
    T = scene.rig.T_cam_from_world[scene.view]
    nothing = np.zeros(3)

    def residuals(turn: Array) -> Array:
        return _residuals(scene, _changed(T, np.concatenate([turn, nothing])))

    found = least_squares(residuals, nothing, loss="soft_l1")
    return _changed(T, np.concatenate([found.x, nothing]))


def _moved(scene: _Scene) -> Float[Array, "4 4"]:
    """Return the extrinsics that fit best of all, from those given and from none."""
    starts = [scene.rig.T_cam_from_world[scene.view]]
    K = np.asarray(scene.rig.K[scene.view], np.float64)
    known, rvec, tvec, _ = cv2.solvePnPRansac(
        scene.points,
        np.ascontiguousarray(scene.ideal_px),
        K,
        None,
        reprojectionError=2 * scene.scale_px,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if known and np.isfinite(tvec).all():
        starts.append(rigid(rotation_from_axis_angle(rvec[:, 0]), tvec[:, 0]))
    found = []
    for T in starts:
        fit = least_squares(lambda x, T=T: _residuals(scene, _changed(T, x)), np.zeros(6), loss="soft_l1")
        found.append((float(fit.cost), _changed(T, fit.x)))
    return min(found, key=lambda pair: pair[0])[1]


def _residuals(scene: _Scene, T: Array) -> Float[Array, " residual"]:
    uv, depth = project(scene.rig.K[scene.view], T, scene.points)
    off = (uv - scene.ideal_px) / scene.scale_px
    return np.where(depth[:, None] > 0, np.clip(off, -1e3, 1e3), 1e3).ravel()


def _changed(T: Array, x: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Turn a camera about its centre by the rotation vector x[:3], then move it in its own frame."""
    return rigid(rotation_from_axis_angle(x[:3]), x[3:]) @ T


def _error_px(scene: _Scene, K: Array, T: Array, ideal_px: Array) -> float:
    uv, depth = project(K, T, scene.points)
    distance = np.linalg.norm(uv - ideal_px, axis=-1)
    return float(np.median(np.where((depth > 0) & np.isfinite(distance), distance, np.inf)))


def _ideal(rig: Rig, view: int, raw: Float[Array, "point 2"]) -> Float[Array, "point 2"]:
    own = rig.select([rig.names[view]])
    return ideal_keypoints(own, raw[None, None, None])[0, 0, 0]


def _in_near(scene: _Scene, rig: Rig, T_cam_from_world: Array) -> Float[Array, "4 4"]:
    T = T_cam_from_world @ invert_rigid(rig.T_cam_from_world[0])
    T[:3, 3] /= scene.extent
    return T


def _in_world(scene: _Scene, rig: Rig, T_cam_from_near: Array) -> Float[Array, "4 4"]:
    T = T_cam_from_near.copy()
    T[:3, 3] *= scene.extent
    return T @ rig.T_cam_from_world[0]
