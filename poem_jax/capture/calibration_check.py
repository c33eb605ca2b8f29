"""What is wrong with a calibration, all that is known together: the rig alone, and its 2D key points."""

import numpy as np

from poem_jax.calibration.findings import Finding
from poem_jax.calibration.hypotheses import explain
from poem_jax.calibration.lens_mistakes import judge_lens
from poem_jax.calibration.rig_alone import DUPLICATE, judge_rig
from poem_jax.calibration.time_words import judge_time
from poem_jax.calibration.view_agreement import UNEXPLAINED, judge_views, spread_frames
from poem_jax.capture.keypoint_agreement import adult_hand_size
from poem_jax.geometry.rig import Rig
from poem_jax.hand.joint_orders import JOINT_ORDERS
from poem_jax.typing import Array, Float

_OF_HANDS = ("joint order", "unit of the rig", "no hand")
"""Findings of `explain` that do not say whether the views agree."""


def check_calibration(
    rig: Rig,
    keypoints_px: Float[Array, "frame hand view 21 2"] | None = None,
    time_s: Float[Array, " frame"] | None = None,
) -> list[Finding]:
    """Say what is wrong with a rig, the likely cause first; [] = nothing is.

    Args:
        rig: The cameras as read.
        keypoints_px: Of hands, in pixels of the raw images, OpenPose order, NaN = unseen; None = none are
            known, and only what the rig shows by itself is said.
        time_s: When the frames were taken, seconds; None = they are evenly spaced, in the order of time.
    """
    doubts = judge_rig(rig)
    if keypoints_px is None:
        return doubts
    certain = [doubt for doubt in doubts if doubt.name == DUPLICATE]
    found = certain or _judge_keypoints(rig, np.asarray(keypoints_px, np.float64), time_s)
    # Hands that are right take the doubts back; where no cause is known they are a hint.
    unexplained = any(finding.name in (*UNEXPLAINED, "no hand") for finding in found)
    return [*found, *(doubt for doubt in doubts if unexplained and doubt not in found)]


def _judge_keypoints(rig: Rig, keypoints_px: Array, time_s: Array | None) -> list[Finding]:
    found = explain(rig, keypoints_px, adult_hand_size(), JOINT_ORDERS, time_s)
    if any(finding.name not in _OF_HANDS for finding in found):
        return found
    views = (
        judge_views(rig, keypoints_px, time_s=time_s)
        or judge_time(rig, keypoints_px, time_s)
        or judge_lens(rig, spread_frames(keypoints_px))
    )
    return [*views, *found]
