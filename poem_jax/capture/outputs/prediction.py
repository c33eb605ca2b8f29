"""`prediction.npz`: everything that was found, as arrays; readable while the take is worked on."""

from pathlib import Path

import numpy as np

from poem_jax.capture.frame import Frame
from poem_jax.capture.take import Take
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES, NUM_SKELETON_JOINTS, NUM_VERTICES
from poem_jax.io.growing_npz import GrowingNpz
from poem_jax.typing import Array, Float

_SHAPES = {
    "joints_world": (NUM_JOINTS, 3),
    "vertices_world": (NUM_VERTICES, 3),
    "root_world": (3,),
    "pose": (NUM_SKELETON_JOINTS, 3),
    "shape": (NUM_SHAPES,),
    "translation": (3,),
    "joint_sigma_m": (NUM_JOINTS,),
}
_POINTS = ("joints_world", "vertices_world", "root_world", "translation")
_WHERE_KNOWN = ("pose", "shape", "translation", "joint_sigma_m", "joint_confidence")
"""Left out of `prediction.npz` where no hand has them."""


class PredictionFile:
    """The arrays of a take, growing on disk with its frames."""

    def __init__(self, path: Path, take: Take, origin_world: Float[Array, "3"]) -> None:
        self._npz = GrowingNpz(path)
        self._take, self._origin_world = take, origin_world
        self._unknown: set[str] = set(_WHERE_KNOWN)
        self.names: list[str] = []
        """Of the frames so far."""

    def add(self, frame: Frame) -> None:
        """Append a frame."""
        self._npz.append(prediction_entry(frame, self._origin_world))
        self.names.append(frame.name)
        self._unknown -= {n for n in self._unknown for hand in frame.hands if getattr(hand, n) is not None}

    def is_due(self) -> bool:
        """Tell whether the file should be written again."""
        return self._npz.is_due()

    def write(self) -> Path:
        """Write the frames so far; the file appears whole or not at all."""
        constant = {
            "frames": self.names,
            "hand_side": self._take.hand_sides,
            "cameras": self._take.rig.names,
        }
        return self._npz.write({k: np.array(v) for k, v in constant.items()}, self._unknown)

    def array(self, name: str) -> Array | None:
        """Return the entries so far of an array, read from disk as they are used; None = no hand has it."""
        return None if name in self._unknown else self._npz.grown(name)

    def close(self) -> None:
        """Let go of what is not needed any more."""
        self._npz.close()


def prediction_entry(frame: Frame, origin_world: Float[Array, "3"]) -> dict[str, Array]:
    """Return what `prediction.npz` holds of a frame; what was not reconstructed is NaN. Metres, world frame.

    `joints_world (H,21,3)`, `vertices_world (H,778,3)`, `root_world (H,3)`, `pose (H,16,3)`, `shape (H,10)`,
    `translation (H,3)`, `joint_sigma_m (H,21)`, `joint_confidence (H,V,21)`, `reprojection_px (H,V)`,
    `views_used (H,V)`, `valid (H,)`, `bridged (H,)`, `time_s ()`, NaN where only the order is known.
    Points are float64 where `origin_world`, which is added to them, is not zero; else numbers are float32.
    """
    hands = frame.hands
    views = frame.boxes_px.shape[1]
    entry = {
        "time_s": np.array(np.nan if frame.time_s is None else frame.time_s, np.float64),
        "reprojection_px": np.full((len(hands), views), np.nan, np.float32),
        "joint_confidence": np.full((len(hands), views, NUM_JOINTS), np.nan, np.float32),
        "views_used": np.stack([hand.view_mask for hand in hands]),
        "valid": np.array([hand.reason is None for hand in hands]),
        "bridged": np.array([hand.bridged for hand in hands]),
    }
    for name, shape in _SHAPES.items():
        far = name in _POINTS and origin_world.any()
        entry[name] = np.full((len(hands), *shape), np.nan, np.float64 if far else np.float32)
    for name in ("reprojection_px", "joint_confidence", *_SHAPES):
        for index, hand in enumerate(hands):
            value = getattr(hand, name)
            if value is not None:
                entry[name][index] = value + origin_world if name in _POINTS else value
    return entry
