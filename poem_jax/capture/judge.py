"""The stage `judge`: how well each hand agrees with what the images say, in raw pixels, view by view."""

from collections.abc import Iterable, Iterator

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.reprojection import Evidence, joints_shown, reprojection_error
from poem_jax.geometry.rig import Rig
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT

_ALL_JOINTS = tuple(range(NUM_JOINTS))


def judge_hands(frames: Iterable[Frame], rig: Rig) -> Iterator[Frame]:
    """Compare hands with the 2D evidence: the key points that were given, else the network's own."""
    for frame in frames:
        hands = (
            hand if hand.joints_world is None else _measured(hand, _evidence(frame, index), rig)
            for index, hand in enumerate(frame.hands)
        )
        yield frame._replace(hands=tuple(hands))


def _evidence(frame: Frame, index: int) -> Evidence:
    if frame.keypoints_px is not None:
        return Evidence(frame.keypoints_px[index], _ALL_JOINTS)
    points_px = frame.hands[index].keypoints_px
    return Evidence(points_px, (ROOT_JOINT,) if points_px.shape[-2] == 1 else _ALL_JOINTS)


def _measured(hand: HandResult, evidence: Evidence, rig: Rig) -> HandResult:
    return hand._replace(
        reprojection_px=reprojection_error(hand.joints_world, evidence, rig),
        joints_shown=joints_shown(hand.joints_world, hand.view_mask, rig),
    )
