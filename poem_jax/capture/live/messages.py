"""The hands of one moment as a line of JSON, for other programs."""

import json
from typing import Any

import numpy as np

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.live.following import SIDES
from poem_jax.typing import Array

_DIGITS = 5
"""Behind the point, of metres: a hundredth of a millimetre."""


def message_of(frame: Frame) -> str:
    """Return the message of a frame.

    {"moment": 17, "time_s": 0.567, "hands": {"right": {"valid": true, "bridged": false,
    "joints_world": [[x, y, z], ... 21], "sigma_m": [... 21]}, "left": {"valid": false, ...}}}: numbers of
    moments grow, with gaps for those that were dropped; metres in the rig's world, OpenPose order; null where
    there is nothing.
    """
    hands = {side: _hand(hand) for side, hand in zip(SIDES, frame.hands, strict=True)}
    assert frame.time_s is not None
    content = {"moment": int(frame.name), "time_s": round(frame.time_s, 4), "hands": hands}
    return json.dumps(content, allow_nan=False, separators=(",", ":"))


def _hand(hand: HandResult) -> dict[str, Any]:
    return {
        "valid": hand.joints_world is not None,
        "bridged": hand.bridged,
        "joints_world": _numbers(hand.joints_world),
        "sigma_m": _numbers(hand.joint_sigma_m),
    }


def _numbers(array: Array | None) -> list | None:
    return None if array is None else np.round(np.asarray(array, np.float64), _DIGITS).tolist()
