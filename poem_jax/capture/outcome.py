"""What came of one hand: its result in the capture's world, or the reason why there is none."""

import numpy as np

from poem_jax.capture.reprojection import given_evidence, joints_shown, model_evidence, reprojection_error
from poem_jax.capture.samples import HandResult, HandSample, mirror_result, mirror_sample
from poem_jax.capture.take import HandOutcome, Take
from poem_jax.geometry.transforms import transform_points

UNDETERMINED = (
    "the views do not determine where the hand is: they stand at one place, or their rays do not cross"
)


def hand_outcome(
    take: Take, frame: int, hand: int, sample: HandSample, result: HandResult, reason: str | None = None
) -> HandOutcome:
    """Judge a model's result, and compare it with the 2D evidence.

    Args:
        take: The capture.
        frame, hand: Which hand.
        sample: What the model was fed; left hands are mirrored there.
        result: What it gave, in the sample's world.
        reason: Why the hand was not reconstructed, where that is known before.
    """
    if take.hands.hand_side[hand] == "left":
        sample, result = mirror_sample(sample), mirror_result(result, sample.views.shape[2])
    reason = reason or _why_not(take, sample, result)
    nothing = np.full(take.rig.num_views, np.nan)
    if reason is not None:
        return HandOutcome(None, sample.view_mask, nothing, nothing, reason)
    if take.hands.keypoints_px is not None:
        evidence = given_evidence(take.hands, frame, hand)
    else:
        evidence = model_evidence(result, sample, take.rig)
    errors = reprojection_error(result.joints_world, evidence, sample.view_mask, take.rig)
    shown = joints_shown(result.joints_world, sample.view_mask, take.rig)
    return HandOutcome(result, sample.view_mask, errors, shown)


def _why_not(take: Take, sample: HandSample, result: HandResult) -> str | None:
    """Return why a result does not count: too few views, no root, or a root that a view cannot have seen."""
    views = int(sample.view_mask.sum())
    if views < 2:
        return f"seen in {views} view(s); two are needed"
    if not result.valid:
        return UNDETERMINED
    root_world = np.asarray(result.root_world, np.float64)
    depth = transform_points(take.rig.T_cam_from_world, root_world[None, None])[:, 0, 2]
    behind = [take.rig.names[view] for view in np.flatnonzero(sample.view_mask & (depth <= 0))]
    return f"the hand would lie behind camera {', '.join(map(repr, behind))}" if behind else None
