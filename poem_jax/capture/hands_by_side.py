"""Hands told apart by the sides that the detector names, whatever the rig says.

This is all there is where one camera alone sees hands, and what a rig is judged by: key points that were put
together by a wrong rig would agree with it, or not be there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from poem_jax.capture.hand_choice import SIDES
from poem_jax.capture.sightings import vote_for_right
from poem_jax.detection import DetectedHand
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.typing import Array, Float


class HandsBySide(NamedTuple):
    """The surest right and the surest left hand of every image."""

    keypoints_px: Float[Array, "frame hand view 21 2"]
    """Raw pixels as given; NaN = unseen."""
    score: Float[Array, "frame hand view"]
    """Of the detections, 0.5 to 1; NaN = unseen."""
    hand_side: tuple[str, ...]
    """`right`, `left`: those that are seen at all."""
    doubled: tuple[int, ...]
    """Frames in which an image shows several hands of one side, of which the surest was taken."""


def hands_by_side(
    detections: Sequence[Sequence[Sequence[DetectedHand]]], num_views: int, max_hands: int = 2
) -> HandsBySide:
    """Take the surest hand of each side in every image.

    Args:
        detections: By frame, view and hand found.
        num_views: Of the rig.
        max_hands: 1 = of both sides the one that is seen more often.
    """
    keypoints = np.full((len(detections), len(SIDES), num_views, NUM_JOINTS, 2), np.nan)
    scores = np.full(keypoints.shape[:3], np.nan)
    doubled: dict[int, None] = {}
    for frame, views in enumerate(detections):
        for view, found in enumerate(views):
            for hand in sorted(found, key=lambda hand: abs(vote_for_right(hand)) + hand.score):
                place = frame, SIDES.index(hand.side), view
                if np.isfinite(scores[place]):
                    doubled[frame] = None
                keypoints[place], scores[place] = hand.keypoints_px, hand.score
    seen = np.isfinite(scores).sum((0, 2))
    best = sorted(np.argsort(-seen, kind="stable")[:max_hands])
    used = [int(i) for i in best if seen[i]]
    sides = tuple(SIDES[i] for i in used)
    return HandsBySide(keypoints[:, used], scores[:, used], sides, tuple(doubled))
