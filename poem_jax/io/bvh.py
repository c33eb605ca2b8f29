"""Moving skeletons as BVH (Biovision hierarchy): offsets of the joints, then one row of numbers a frame.

The root has three numbers for its place and three angles, every other joint three angles, in degrees: Z, X,
Y, each turn about the axes that the one before has moved, so that R = Rz Rx Ry, from the joint's frame to its
parent's.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float

_TURNS = "Zrotation Xrotation Yrotation"


class BvhSkeleton(NamedTuple):
    """Joints at rest, none of them turned, in any unit of length."""

    names: Sequence[str]
    parents: Sequence[int]
    """-1 for the first; a joint comes after its parent."""
    offsets: Float[Array, "joint 3"]
    """From the parent; the root's is not used, as its place is in every frame."""
    ends: dict[int, Float[Array, "3"]]
    """Where the bones of the last joints end, from these."""


def write_bvh(
    path: Path,
    skeleton: BvhSkeleton,
    root: Float[Array, "frame 3"],
    rotations: Float[Array, "frame joint 3 3"],
    seconds_per_frame: float,
) -> Path:
    """Write a motion at a constant rate; the file appears whole or not at all.

    Args:
        path: The file.
        skeleton: What moves.
        root: Place of the first joint.
        rotations: R_parent_from_joint; of the first joint R_world_from_joint.
        seconds_per_frame: The rate.
    """
    order = _depth_first(skeleton)
    angles = [_angles(rotations[:, joint]) for joint in order]
    rows = np.concatenate([np.asarray(root, float), *angles], axis=1)
    with whole_file(path) as temporary, temporary.open("w", encoding="ascii") as stream:
        stream.write("HIERARCHY\n")
        _write_joint(stream, skeleton, order[0], "")
        stream.write(f"MOTION\nFrames: {len(rows)}\nFrame Time: {seconds_per_frame:.9g}\n")
        np.savetxt(stream, rows, fmt="%.6f")
    return path


def _angles(R: Float[Array, "frame 3 3"]) -> Float[Array, "frame 3"]:
    """Return Z, X and Y angles in degrees, without jumps of full turns."""
    with warnings.catch_warnings():
        # Where X is a quarter turn one of the others is free; what is returned is right there, too.
        warnings.filterwarnings("ignore", message="Gimbal lock detected")
        angles = Rotation.from_matrix(np.asarray(R, float)).as_euler("ZXY")
    return np.rad2deg(np.unwrap(angles, axis=0))


def _children(skeleton: BvhSkeleton, joint: int) -> list[int]:
    return [child for child, parent in enumerate(skeleton.parents) if parent == joint]


def _depth_first(skeleton: BvhSkeleton, joint: int = 0) -> list[int]:
    below = (_depth_first(skeleton, child) for child in _children(skeleton, joint))
    return [joint, *(one for branch in below for one in branch)]


def _write_joint(stream: TextIO, skeleton: BvhSkeleton, joint: int, indent: str) -> None:
    kind, channels = "JOINT", f"3 {_TURNS}"
    offset = skeleton.offsets[joint]
    if skeleton.parents[joint] < 0:
        kind, channels, offset = "ROOT", f"6 Xposition Yposition Zposition {_TURNS}", np.zeros(3)
    stream.write(f"{indent}{kind} {skeleton.names[joint]}\n{indent}{{\n")
    stream.write(f"{indent}  OFFSET {_three(offset)}\n{indent}  CHANNELS {channels}\n")
    for child in _children(skeleton, joint):
        _write_joint(stream, skeleton, child, f"{indent}  ")
    if joint in skeleton.ends:
        end = f"{indent}  End Site\n{indent}  {{\n{indent}    OFFSET {_three(skeleton.ends[joint])}\n"
        stream.write(f"{end}{indent}  }}\n")
    stream.write(f"{indent}}}\n")


def _three(values: Array) -> str:
    return " ".join(f"{value:.6f}" for value in values)
