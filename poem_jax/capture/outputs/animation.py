"""`hands.glb`: the take as one animation that programs such as Blender and three.js open, y up, in metres.

Each hand is a mesh that follows a skeleton of 16 joints. Where the skinned mesh does not follow what the
engine gave closely enough, the hand moves vertex by vertex instead. All hangs on a node `capture`, which
turns the capture's axes upright; below it they are as in `rig.json`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.capture.outputs.motion import HandMotion, TakeMotion
from poem_jax.geometry.transforms import quaternion_from_rotation
from poem_jax.hand.corrections import few_corrections
from poem_jax.hand.topology import MANO_PARENTS, SKELETON_JOINT_NAMES
from poem_jax.io.glb import Glb
from poem_jax.io.morphing_mesh import add_morphing_mesh
from poem_jax.io.skinned_mesh import Skin, SkinMotion, add_skinned_mesh
from poem_jax.typing import Array, Float, Int
from poem_jax.viz.page import HAND_RGB

MAX_SKIN_ERROR_M = 0.008
"""Mean distance of the skinned vertices from those that the engine gave, beyond which these are kept. The
shipped network's meshes of real hands lie 4.2 to 4.4 mm from a skinned hand that has their joints (4.7 to 6.4
with earlier weights), and their joints 11 mm from triangulated ones."""
_FRAMES_COMPARED = 100
"""Spread over the take."""


def write_animation(
    path: Path,
    motion: TakeMotion,
    vertices_of: Callable[[int, int], Float[Array, "778 3"]],
    faces: Mapping[str, Int[Array, "face 3"]],
) -> dict[str, Any]:
    """Write the animation, whole or not at all.

    Args:
        path: The file.
        motion: Of the take.
        vertices_of: Gives the vertices of a frame and a hand (numbers), metres, from the motion's origin.
        faces: Triangles by side.

    The animation begins with the take's first frame, whenever that was.

    Returns: for the report, per hand how it moves and how far that is from what the engine gave.
    """
    time_s = motion.time_s - motion.time_s[0]
    said: dict[str, Any] = {}
    with Glb() as glb:
        upright = quaternion_from_rotation(motion.R_upright_from_world)[[1, 2, 3, 0]].tolist()
        below: list[int] = []
        capture = glb.node(name="capture", rotation=upright)
        glb.roots.append(capture)
        for index, hand in enumerate(motion.hands):

            def vertices(frame: int, index: int = index) -> Array:
                return vertices_of(frame, index)

            error = _skin_error_m(hand, vertices)
            rgb = HAND_RGB[hand.side]
            if error is not None and error <= MAX_SKIN_ERROR_M:
                mesh, wrist = add_skinned_mesh(glb, hand.name, rgb, *_skinned(hand, time_s))
                glb.roots.append(mesh)
                below.append(wrist)
            else:
                nodes = add_morphing_mesh(glb, hand.name, faces[hand.side], rgb, vertices, hand.seen, time_s)
                below += nodes
            said[hand.name] = _said(hand, error)
        if below:
            glb.nodes[capture]["children"] = below
        glb.write(path)
    return said


def _skinned(hand: HandMotion, time_s: Float[Array, " frame"]) -> tuple[Skin, SkinMotion]:
    skeleton = hand.skeleton
    assert skeleton is not None
    shaped, model = skeleton.shaped, skeleton.hand
    corrections = few_corrections(model, skeleton.rotations[hand.seen])
    weights = np.zeros((len(time_s), len(corrections.targets)))
    weights[hand.seen] = corrections.weights
    names, parents = SKELETON_JOINT_NAMES, MANO_PARENTS
    rest = (shaped.vertices + corrections.base, model.faces, model.weights, shaped.skeleton)
    skin = Skin(*rest, parents, names, corrections.targets)
    turns = quaternion_from_rotation(skeleton.rotations)
    return skin, SkinMotion(time_s, hand.seen, turns, skeleton.wrist, weights)


def _skin_error_m(hand: HandMotion, vertices_of: Callable[[int], Array]) -> float | None:
    """Return the mean distance of skinned vertices from given ones over some frames; None = no skeleton."""
    if hand.skeleton is None:
        return None
    frames = np.flatnonzero(hand.seen)
    frames = frames[np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES_COMPARED)).astype(int)]
    offsets = [hand.skeleton.vertices(frame) - vertices_of(frame) for frame in frames.tolist()]
    return float(np.mean([np.linalg.norm(offset, axis=-1).mean() for offset in offsets]))


def _said(hand: HandMotion, error_m: float | None) -> dict[str, Any]:
    if error_m is None:
        return {"moves_by": "vertices", "because": "it is never seen, or its hand model is not known"}
    if error_m > MAX_SKIN_ERROR_M:
        because = (
            f"the skinned mesh lies {1000 * error_m:.1f} mm from the engine's, more than "
            f"{1000 * MAX_SKIN_ERROR_M:g}"
        )
        return {"moves_by": "vertices", "because": because}
    pose = "found from the joints" if hand.skeleton and hand.skeleton.from_joints else "the engine's"
    return {"moves_by": "skeleton", "pose": pose, "mean_distance_mm": round(1000 * error_m, 3)}
