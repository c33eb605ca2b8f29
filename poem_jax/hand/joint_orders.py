"""Orders in which data sets and detectors list the 21 key points; the house's own is OpenPose's."""

from typing import Final

from poem_jax.hand.topology import NUM_FINGERS, NUM_JOINTS, OPENPOSE_FROM_MANO, WRIST

_THUMB_FIRST = range(NUM_FINGERS)
_LITTLE_FIRST = range(NUM_FINGERS)[::-1]


def _fingers(fingers: range, *, tip_first: bool) -> tuple[int, ...]:
    steps = range(4, 0, -1) if tip_first else range(1, 5)
    return tuple(4 * finger + step for finger in fingers for step in steps)


def _listing(order: tuple[int, ...]) -> tuple[int, ...]:
    """Return where each key point stands, from which key point stands where."""
    return tuple(order.index(joint) for joint in range(NUM_JOINTS))


JOINT_ORDERS: Final[dict[str, tuple[int, ...]]] = {
    "MANO's (wrist; index, middle, little, ring, thumb; tips)": OPENPOSE_FROM_MANO,
    "wrist, then thumb to little finger, each from tip to base (RHD)": _listing(
        (WRIST, *_fingers(_THUMB_FIRST, tip_first=True))
    ),
    "thumb to little finger, each from tip to base, then the wrist (InterHand2.6M)": _listing(
        (*_fingers(_THUMB_FIRST, tip_first=True), WRIST)
    ),
    "thumb to little finger, each from base to tip, then the wrist": _listing(
        (*_fingers(_THUMB_FIRST, tip_first=False), WRIST)
    ),
    "wrist, then little finger to thumb, each from base to tip": _listing(
        (WRIST, *_fingers(_LITTLE_FIRST, tip_first=False))
    ),
    "wrist, then little finger to thumb, each from tip to base": _listing(
        (WRIST, *_fingers(_LITTLE_FIRST, tip_first=True))
    ),
    "wrist, then the bases of all fingers, their next joints, and so on to the tips": _listing(
        (WRIST, *(4 * finger + step for step in range(1, 5) for finger in _THUMB_FIRST))
    ),
}
"""Where each key point of OpenPose's order stands in the other: openpose = other[..., order, :]."""
