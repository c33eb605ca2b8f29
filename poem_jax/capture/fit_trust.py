"""How far each view bears out a hand that was fitted to key points."""

from typing import TYPE_CHECKING

import numpy as np

from poem_jax.fitting.robust_weight import agreement
from poem_jax.geometry.cameras import project
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float

if TYPE_CHECKING:
    from poem_jax.fitting import FitResult


def joint_confidence(
    fitted: "FitResult", keypoints: Array, confidence: Array, rig: Rig
) -> Float[Array, "frame view 21"]:
    """Return how far each view bears each joint out: the detector's confidence times the key point's
    agreement with the hand, beside the noise of all key points of the take.

    Args:
        fitted: A hand over some frames.
        keypoints: Those it was fitted to (frame, view, 21, 2), pixels without distortion; NaN = unseen.
        confidence: Of the key points (frame, view, 21), 0 to 1.
        rig: The cameras.

    Returns: 0 for a key point that the triangulation left out, as it agrees with no other view; NaN = unseen.
    """
    expected_px, _ = project(rig.K, rig.T_cam_from_world, np.asarray(fitted.keypoints, np.float64)[:, None])
    off_px = np.linalg.norm(expected_px - keypoints, axis=-1)
    agreed = agreement(off_px, np.asarray(fitted.sigma_px, np.float64)[:, None, None])
    trusted = np.clip(confidence, 0.0, 1.0) * np.where(fitted.inlier_mask, agreed, 0.0)
    seen = np.isfinite(keypoints).all(-1) & (confidence > 0)
    return np.where(seen, trusted, np.nan)
