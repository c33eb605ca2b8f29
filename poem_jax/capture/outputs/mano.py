"""`mano.npz`: the hands' parameters as the `smplx` library takes them (MANO, and the hands of SMPL-X)."""

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from poem_jax.capture.outputs.motion import TakeMotion
from poem_jax.geometry.transforms import axis_angle_from_rotation
from poem_jax.hand.conventions import FINGER_NUMBERS
from poem_jax.hand.model import HandModel
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_SHAPES
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array

_log = logging.getLogger(__name__)


def write_mano(path: Path, take: TakeMotion, hands: Mapping[str, HandModel]) -> Path:
    """Write the parameters of all hands; the file appears whole or not at all.

    `global_orient (F,H,3)`, `hand_pose (F,H,45)` (axis-angle, zero = flat hand: `flat_hand_mean=True`),
    `transl (F,H,3)`, `betas (F,H,10)`, `valid (F,H)`, `bridged (F,H)`, `time_s (F,)`, `frames (F,)`,
    `hand_side (H,)`, `hand_model`; radians, metres, the capture's world; NaN where there is no hand. The
    shape coefficients of the hand that ships are not MANO's: they are called `shape_of_shipped_hand`.
    """
    shipped = any(_is_shipped(hand) for hand in hands.values())
    parts = [_parameters(take, index) for index in range(len(take.hands))]
    arrays = {name: np.stack([part[name] for part in parts], axis=1) for name in parts[0]}
    if shipped:
        arrays["shape_of_shipped_hand"] = arrays.pop("betas")
        _log.warning(
            "%s holds poses of the hand that ships, whose shape coefficients and joints are not MANO's; "
            "give MANO_RIGHT.pkl by --mano for parameters of MANO",
            path.name,
        )
    about = {
        "time_s": take.time_s,
        "frames": np.array(take.frames),
        "hand_side": np.array([hand.side for hand in take.hands]),
        "hand_model": np.array("the shipped hand, not MANO" if shipped else "as given: MANO's"),
    }
    with whole_file(path) as temporary:
        np.savez(temporary, **arrays, **about)
    return path


def _parameters(take: TakeMotion, index: int) -> dict[str, Array]:
    hand = take.hands[index]
    frames, skeleton = len(hand.seen), hand.skeleton
    sizes = {"global_orient": 3, "hand_pose": FINGER_NUMBERS, "transl": 3, "betas": NUM_SHAPES}
    arrays = {name: np.full((frames, size), np.nan) for name, size in sizes.items()}
    if skeleton is not None:
        pose = axis_angle_from_rotation(skeleton.rotations[hand.seen].astype(np.float64))
        arrays["global_orient"][hand.seen] = pose[:, 0]
        arrays["hand_pose"][hand.seen] = pose[:, 1:].reshape(-1, FINGER_NUMBERS)
        rest_wrist = skeleton.shaped.skeleton[0]
        arrays["transl"][hand.seen] = skeleton.wrist[hand.seen] + take.origin_world - rest_wrist
        arrays["betas"][hand.seen] = skeleton.shape
    return {**arrays, "valid": hand.seen, "bridged": hand.bridged}


def _is_shipped(hand: HandModel) -> bool:
    return np.array_equal(np.asarray(hand.v_template), default_hand(hand.side).v_template)
