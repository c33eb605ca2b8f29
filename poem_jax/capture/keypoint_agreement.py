"""Whether the rig of a take and its 2D key points agree, and whether they are those of the hand they claim.

Triangulated points of an impossible size, or none at all, are an error: nothing right can come of them. Views
that do not fit together are a warning, as others may serve (`calibration.view_agreement`).
"""

import functools
from typing import TYPE_CHECKING

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.calibration.hypotheses import MIN_AGREEING, HandSize, explain
from poem_jax.capture.frame_padding import padded_frames
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.world_origin import distant_origin, move_origin
from poem_jax.hand.joint_orders import JOINT_ORDERS
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.topology import BONES, NUM_SHAPES, NUM_SKELETON_JOINTS, ROOT_JOINT, WRIST
from poem_jax.typing import Array, Float

if TYPE_CHECKING:
    from poem_jax.fitting import FitResult, KeypointNoise
    from poem_jax.fitting.robust_triangulation import RobustPoints

PALM_M = (0.04, 0.16)
"""From the wrist to the middle knuckle, metres: no hand is outside."""
ADULT_PALM_M = 0.093

_MIN_GAIN = 5.0
_MIN_SHARE_OF_FRAMES = 0.75
"""The mirror image must be likelier by e^5 in the median frame, and likelier at all in three of four."""
_FITS_NOT = 4.0


def check_triangulation(rig: Rig, keypoints_px: Float[Array, "frame hand view 21 2"]) -> None:
    """Raise if the key points cannot be triangulated, or give hands of an impossible size.

    Args:
        rig: The cameras.
        keypoints_px: In pixels of the raw images; NaN = unseen.

    Raises:
        ValueError: A mistake explains it, which the message names with its fix (`calibration.hypotheses`), or
            the hands are of an impossible size for a reason unknown.
    """
    ideal = ideal_keypoints(rig, keypoints_px)
    points = _triangulated(rig, ideal)
    palm_m = _palm_length(points)
    if _agreeing_share(points, ideal) >= MIN_AGREEING and PALM_M[0] <= palm_m <= PALM_M[1]:
        return
    findings = explain(rig, keypoints_px, adult_hand_size(), JOINT_ORDERS)
    if PALM_M[0] <= palm_m <= PALM_M[1]:
        # Where some views may serve those that do not are named as a warning.
        findings = [finding for finding in findings if finding.fatal]
    if findings:
        raise ValueError("; and ".join(map(str, findings)))
    if not PALM_M[0] <= palm_m <= PALM_M[1]:
        raise ValueError(
            f"the hands' palms (wrist to middle knuckle) come out as {palm_m:.3g} m, expected {PALM_M[0]} to "
            f"{PALM_M[1]}, and no known mistake explains it; check rig and key points"
        )


def shows_palms(keypoints_px: Float[Array, "frame hand view 21 2"]) -> bool:
    """Tell whether two views see the ends of a palm, without which no size can be judged."""
    twice = np.isfinite(keypoints_px).all(-1).sum(2) >= 2
    return bool((twice[..., WRIST] & twice[..., ROOT_JOINT]).any())


@functools.cache
def adult_hand_size() -> HandSize:
    """Return the bones of the shipped hand, between key points in OpenPose's order."""
    from poem_jax.hand.template import default_hand

    hand = default_hand()
    joints = hand_mesh(hand, np.zeros((NUM_SKELETON_JOINTS, 3)), np.zeros(NUM_SHAPES)).joints
    a, b = np.asarray(joints, np.float64)[np.array(BONES).T]
    return HandSize(BONES, np.linalg.norm(a - b, axis=-1))


def _palm_length(points: "RobustPoints") -> float:
    """Return the median distance from wrist to middle knuckle, metres; an adult's where none is seen."""
    both = points.valid[..., WRIST] & points.valid[..., ROOT_JOINT]
    palm = np.linalg.norm(points.points[..., WRIST, :] - points.points[..., ROOT_JOINT, :], axis=-1)
    return float(np.median(palm[both])) if both.any() else ADULT_PALM_M


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
    if gain.size and np.median(gain) > _MIN_GAIN and (gain > 0).mean() >= _MIN_SHARE_OF_FRAMES:
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
