"""The files for other programs, written once all frames are known."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.capture.outputs.animation import write_animation
from poem_jax.capture.outputs.formats import Format
from poem_jax.capture.outputs.mano import write_mano
from poem_jax.capture.outputs.motion import take_motion
from poem_jax.capture.outputs.prediction import PredictionFile
from poem_jax.capture.outputs.skeletons import write_skeleton
from poem_jax.capture.outputs.tables import write_angles, write_joints, write_markers
from poem_jax.capture.take import Take
from poem_jax.geometry.upright import upright_rotation
from poem_jax.hand.model import HandModel
from poem_jax.typing import Array, Float, Int

ANIMATION = "hands.glb"
JOINTS, ANGLES, MARKERS, PARAMETERS = "joints.csv", "joint_angles.csv", "hands.trc", "mano.npz"
_NEED_A_MODEL = (Format.BVH, Format.MANO)

_log = logging.getLogger(__name__)


class Exports(NamedTuple):
    """What was written."""

    files: list[Path]
    about: dict[str, Any]
    """For the report."""


def export_files(out: Path, hand_names: Sequence[str], formats: frozenset[Format]) -> list[Path]:
    """Return the files for other programs that the given formats may bring."""
    names = {
        Format.GLB: [ANIMATION],
        Format.BVH: [f"{name}.bvh" for name in hand_names],
        Format.CSV: [JOINTS, ANGLES],
        Format.TRC: [MARKERS],
        Format.MANO: [PARAMETERS],
    }
    return [out / name for kind in sorted(formats & names.keys()) for name in names[kind]]


def write_exports(
    out: Path,
    take: Take,
    prediction: PredictionFile,
    hands: Mapping[str, HandModel] | None,
    faces: Mapping[str, Int[Array, "face 3"]],
    formats: frozenset[Format],
    origin_world: Float[Array, "3"],
) -> Exports:
    """Write the chosen files of a take in which a hand was found.

    Args:
        out: Folder for them.
        take: The capture, its cameras in the world whose origin is `origin_world`.
        prediction: All that was found.
        hands: The hand models by side, None = not known; then a warning says what cannot be written.
        faces: Triangles by side.
        formats: What to write.
        origin_world: Where the take's cameras are measured from, in the capture's world.
    """
    files: list[Path] = []
    about: dict[str, Any] = {}
    if not export_files(out, take.hand_names, formats):
        return Exports(files, about)
    upright = upright_rotation(take.rig.T_cam_from_world)
    motion = take_motion(
        prediction.names, take.hand_names, take.hand_sides, prediction.array, hands, origin_world, upright
    )
    if origin_world.any():
        about["origin_world_m"] = np.asarray(origin_world, float).tolist()
    if hands is None and formats & set(_NEED_A_MODEL):
        _log.warning("no hand model is known: %s is not written", " and ".join(_NEED_A_MODEL))
    if Format.GLB in formats:
        vertices = prediction.array("vertices_world")
        assert vertices is not None

        def vertices_of(frame: int, hand: int) -> Array:
            return vertices[frame, hand] - origin_world

        about["animation"] = write_animation(out / ANIMATION, motion, vertices_of, faces)
        about["animation_begins_s"] = float(motion.time_s[0])
        files.append(out / ANIMATION)
    if Format.BVH in formats:
        seen = [hand for hand in motion.hands if hand.skeleton is not None]
        files += [write_skeleton(out / f"{hand.name}.bvh", hand, motion) for hand in seen]
    if Format.CSV in formats:
        files += [write_joints(out / JOINTS, motion), write_angles(out / ANGLES, motion)]
    if Format.TRC in formats:
        files.append(write_markers(out / MARKERS, motion))
    if Format.MANO in formats and hands is not None:
        files.append(write_mano(out / PARAMETERS, motion, hands))
    return Exports(files, about)
