"""Whether the rig of a take and its 2D key points agree, and whether they are those of the hand they claim.

Two views of one point satisfy the epipolar constraint; where the key points of a pair of cameras miss it by
far in most frames, one of the two is badly calibrated or not in time. That is a warning, for other pairs may
serve. Triangulated points of an impossible size, or none at all, are an error: nothing right can come of
them.
"""

import functools
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from poem_jax.capture.frame_padding import padded_frames
from poem_jax.geometry.camera_checks import INVERTED
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid, skew_matrix
from poem_jax.geometry.world_origin import distant_origin, move_origin
from poem_jax.hand.topology import ROOT_JOINT, WRIST
from poem_jax.typing import Array, Float

if TYPE_CHECKING:
    from poem_jax.fitting import FitResult, KeypointNoise
    from poem_jax.fitting.robust_triangulation import RobustPoints

PALM_M = (0.04, 0.16)
"""From the wrist to the middle knuckle, metres: no hand is outside."""
ADULT_PALM_M = 0.093

_SUSPICIOUS_SHARE = 0.006
"""Of the diagonal of the images: a median epipolar distance beyond it is more than detectors' noise. Chosen
between the 0.3 % of usable rigs and the 0.7 % of a bad one, on four captures."""
_LEAST_POINTS = 21
_LEAST_GAIN = 5.0
_MOST_FRAMES = 0.75
"""The mirror image must be likelier by e^5 in the median frame, and likelier at all in three of four."""
_FITS_NOT = 4.0
_AGREEING = (0.75, 0.9)
"""Shares of the key points on which views agree: below the first, extrinsics are wrong; above the second
their inverses are right."""


def epipolar_distances_px(
    rig: Rig, keypoints_px: Float[Array, "frame hand view 21 2"]
) -> Float[Array, "view view"]:
    """Return the median distance of key points from their epipolar lines for every pair of cameras.

    The first-order geometric distance |x_b^T F x_a| / |(F x_a, F^T x_b)_xy| (Hartley and Zisserman, 11.9),
    pixels of the undistorted images; NaN on the diagonal and where a pair shares fewer than 21 key points.
    """
    distances = np.full((rig.num_views, rig.num_views), np.nan)
    ones = np.ones((*keypoints_px.shape[:-1], 1))
    points = np.moveaxis(np.concatenate([keypoints_px, ones], -1), 2, 0).reshape(rig.num_views, -1, 3)
    for a, b in combinations(range(rig.num_views), 2):
        T_b_from_a = rig.T_cam_from_world[b] @ invert_rigid(rig.T_cam_from_world[a])
        essential = skew_matrix(T_b_from_a[:3, 3]) @ T_b_from_a[:3, :3]
        F = np.linalg.inv(rig.K[b]).T @ essential @ np.linalg.inv(rig.K[a])
        lines_b, lines_a = points[a] @ F.T, points[b] @ F
        slope = np.sqrt((lines_a[:, :2] ** 2).sum(-1) + (lines_b[:, :2] ** 2).sum(-1))
        found = np.abs((lines_b * points[b]).sum(-1)) / np.maximum(slope, 1e-12)
        found = found[np.isfinite(found)]
        if len(found) >= _LEAST_POINTS:
            distances[a, b] = distances[b, a] = np.median(found)
    return distances


def judge_pairs(rig: Rig, keypoints_px: Float[Array, "frame hand view 21 2"]) -> list[str]:
    """Return a warning that names the cameras whose key points do not fit together, if there are any."""
    distances = epipolar_distances_px(rig, keypoints_px)
    limit = _SUSPICIOUS_SHARE * np.linalg.norm(rig.size_wh, axis=-1).mean()
    pairs = [(a, b) for a, b in combinations(range(rig.num_views), 2) if distances[a, b] > limit]
    if not pairs:
        return []
    named = ", ".join(
        f"'{rig.names[a]}' and '{rig.names[b]}' {distances[a, b]:.0f} px"
        for a, b in sorted(pairs, key=lambda pair: -distances[pair])
    )
    return [
        f"the key points of these cameras do not fit together: {named} off each other's epipolar lines "
        f"(median; expected below {limit:.0f} px). Calibration, or frames that are not of one moment? The "
        "results are not to be trusted to the millimetre"
    ]


def check_triangulation(rig: Rig, keypoints_px: Float[Array, "frame hand view 21 2"]) -> None:
    """Raise if the key points cannot be triangulated, or give hands of an impossible size.

    Raises:
        ValueError: The extrinsics map camera to world; their unit is not what the rig says. The message
            says what one unit seems to be.
    """
    points = _triangulated(rig, keypoints_px)
    if _agreeing_share(points, keypoints_px) < _AGREEING[0]:
        inverse = rig._replace(T_cam_from_world=invert_rigid(rig.T_cam_from_world))
        if _agreeing_share(_triangulated(inverse, keypoints_px), keypoints_px) > _AGREEING[1]:
            raise ValueError(INVERTED)
    both = points.valid[..., WRIST] & points.valid[..., ROOT_JOINT]
    if not both.any():
        return
    palm = np.linalg.norm(points.points[..., WRIST, :] - points.points[..., ROOT_JOINT, :], axis=-1)
    length = float(np.median(palm[both]))
    if not PALM_M[0] <= length <= PALM_M[1]:
        raise ValueError(
            f"the rig's lengths are not metres: the hands' palms (wrist to middle knuckle) come out as "
            f"{length:.3g} m, expected {PALM_M[0]} to {PALM_M[1]}. If the hands are adult, one unit of the "
            f"rig is about {1000 * ADULT_PALM_M / length:.2g} mm of what it says it is: correct `unit`, or "
            "scale every `t`"
        )


def judge_fit(name: str, own: "FitResult", other: "FitResult", noise: "KeypointNoise") -> list[str]:
    """Return what is to be said of a fitted hand: it is of the other side, or its joints in another order.

    Args:
        name: Of the hand.
        own: The fit of the side that the file names.
        other: The fit of the opposite side.
        noise: What was expected of the key points.
    """
    error = min(_median_error(own), _median_error(other))
    if error > _FITS_NOT * _expected_error(own, noise):
        return [
            f"hand '{name}': the views agree with each other to {np.median(own.sigma_px):.1f} px, but no "
            f"hand of either side fits the key points better than {error:.1f} px; check that the joints are "
            "in OpenPose order (wrist, then thumb to little finger, each from its base to its tip)"
        ]
    gain = own.cost - other.cost
    gain = gain[np.isfinite(gain)]
    if gain.size and np.median(gain) > _LEAST_GAIN and (gain > 0).mean() >= _MOST_FRAMES:
        return [
            f"hand '{name}' seems to be of the other side: its mirror image is likelier by a factor of "
            f"e^{np.median(gain):.0f} a frame (median), as its joints bend the natural way; check `hand_side`"
        ]
    return []


def _expected_error(fitted: "FitResult", noise: "KeypointNoise") -> float:
    """Return the distance that the noise of the key points alone gives, pixels."""
    return max(float(np.max(fitted.sigma_px)), noise.expected_px) * np.sqrt(2)


def _agreeing_share(points: "RobustPoints", keypoints_px: Array) -> float:
    """Return the share of the key points, of joints that two views see, that agree with each other."""
    seen = np.isfinite(keypoints_px).all(-1)
    seen &= seen.sum(2, keepdims=True) >= 2
    return float(points.inlier_mask[seen].mean()) if seen.any() else 1.0


def _median_error(fitted: "FitResult") -> float:
    values = np.where(fitted.inlier_mask.any(-1), fitted.reprojection_px, np.nan)
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else np.nan


def _triangulated(rig: Rig, keypoints_px: Array) -> "RobustPoints":
    """Triangulate (frame, hand, view, 21, 2), the noise estimated over the frames of each hand.

    A far world's points come out as seen from near its cameras: only their distances matter here.
    """
    import jax

    from poem_jax.fitting import KeypointNoise, Observations

    T_cam_from_near = move_origin(rig.T_cam_from_world, distant_origin(rig.T_cam_from_world))
    observations = Observations(padded_frames(keypoints_px), None, rig.K, T_cam_from_near)
    points = jax.device_get(_program(KeypointNoise.of_images(rig.size_wh))(observations))
    return jax.tree.map(lambda array: array[: len(keypoints_px)], points)


@functools.cache
def _program(noise: "KeypointNoise"):
    import jax

    from poem_jax.fitting import triangulate_robust

    return jax.jit(functools.partial(triangulate_robust, noise=noise, frame_axis=0))
