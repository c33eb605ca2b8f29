"""The first stage of the live line: from moments to frames that know where the hands are in every view."""

import logging
from collections.abc import Iterable, Iterator

import numpy as np

from poem_jax.capture.boxes_file import boxes_from_keypoints
from poem_jax.capture.detect import Detector
from poem_jax.capture.detections import within_images
from poem_jax.capture.frame import Frame
from poem_jax.capture.live.following import HandFollower
from poem_jax.capture.live.moments import Moment
from poem_jax.capture.live.pace import Pace
from poem_jax.geometry.rig import Rig
from poem_jax.hand.topology import NUM_JOINTS

_MANY = 30
"""Moments in which several views show hands, and no two of them agree, after which this is said."""

_log = logging.getLogger(__name__)


def find_in_moments(moments: Iterable[Moment], rig: Rig, detector: Detector, pace: Pace) -> Iterator[Frame]:
    """Look for the hands of one person in every moment.

    Args:
        moments: Taken as the line is ready for them.
        rig: The cameras.
        detector: Finds the hands in the images of some views.
        pace: Is told of every moment.

    Returns: frames with images and key points, hands in the order of `following.SIDES`, named by the numbers
        of their moments.
    """
    follower = HandFollower(rig)
    unplaced = 0
    for moment in moments:
        pace.begin(moment)
        images = {view: image for view, image in enumerate(moment.images) if image is not None}
        hands = dict(zip(images, detector(list(images), list(images.values())), strict=True))
        found = [hands.get(view, ()) for view in range(rig.num_views)]
        followed = follower.follow(moment.time_s, found)
        if unplaced is not None:
            unplaced = _tell_unplaced(unplaced, followed.placed, sum(map(bool, found)), rig)
        keypoints = within_images(followed.keypoints_px[None], rig)[0]
        pace.detected()
        yield Frame(
            f"{moment.number:06d}",
            boxes_from_keypoints(keypoints),
            keypoints,
            np.repeat(followed.score[..., None], NUM_JOINTS, axis=-1),
            images=moment.images,
            time_s=moment.time_s,
        )


def _tell_unplaced(unplaced: int, placed: int, views: int, rig: Rig) -> int | None:
    """Count moments that should have shown a hand; None = nothing more to say."""
    if placed:
        return None
    unplaced += views >= 2
    if unplaced < _MANY:
        return unplaced
    _log.warning(
        "hands were found in %d moments, and no two of the cameras %s agree on any: check the calibration "
        "(`poem calibration check`), and that the cameras take their pictures at the same time",
        *(unplaced, ", ".join(rig.names)),
    )
    return None
