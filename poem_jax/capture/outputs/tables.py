"""Tables of a take: `joints.csv`, `joint_angles.csv` and, as markers, `hands.trc`."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from poem_jax.capture.outputs.motion import HandMotion, TakeMotion, seconds_per_frame
from poem_jax.geometry.transforms import axis_angle_from_rotation
from poem_jax.hand.joint_limits import ANGLE_NAMES, anatomical_angles, anatomical_axes
from poem_jax.hand.topology import JOINT_NAMES, SKELETON_JOINT_NAMES
from poem_jax.io.atomic import whole_file
from poem_jax.io.trc import write_trc
from poem_jax.typing import Array, Float


def write_joints(path: Path, take: TakeMotion) -> Path:
    """Write the joints, metres in the capture's world, one row a frame; what is not there is empty."""
    columns = [f"{joint}_{axis}_m" for joint in JOINT_NAMES for axis in "xyz"]
    values = [(hand.joints + take.origin_world).reshape(len(take.frames), -1) for hand in take.hands]
    return _write(path, take, columns, values, "%.6f")


def write_angles(path: Path, take: TakeMotion) -> Path:
    """Write the angles of the bending joints in degrees (`hand/joint_limits.py`), one row a frame."""
    columns = [f"{joint}_{angle}_deg" for joint in SKELETON_JOINT_NAMES[1:] for angle in ANGLE_NAMES]
    values = [np.rad2deg(_angles(hand)).reshape(len(take.frames), -1) for hand in take.hands]
    return _write(path, take, columns, values, "%.3f")


def write_markers(path: Path, take: TakeMotion) -> Path:
    """Write the joints as markers, millimetres, y up."""
    markers = [f"{hand.name}_{joint}" for hand in take.hands for joint in JOINT_NAMES]
    points = np.concatenate([1000 * take.upright(hand.joints) for hand in take.hands], axis=1)
    return write_trc(path, markers, take.time_s, points, 1 / seconds_per_frame(take.time_s))


def _angles(hand: HandMotion) -> Float[Array, "frame 15 3"]:
    skeleton = hand.skeleton
    if skeleton is None:
        return np.full((len(hand.seen), len(SKELETON_JOINT_NAMES) - 1, len(ANGLE_NAMES)), np.nan)
    pose = axis_angle_from_rotation(skeleton.rotations.astype(np.float64))
    angles = anatomical_angles(pose, anatomical_axes(skeleton.hand))
    return np.where(hand.seen[:, None, None], angles, np.nan)


def _write(path: Path, take: TakeMotion, columns: Sequence[str], values: Sequence[Array], how: str) -> Path:
    """Write frame, time, and per hand whether it is there, whether it is bridged, and its columns."""
    head = ["frame", "time_s"]
    for hand in take.hands:
        head += [f"{hand.name}_{column}" for column in ("valid", "bridged", *columns)]
    with whole_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(head)
        for index, (name, time) in enumerate(zip(take.frames, take.time_s, strict=True)):
            row = [name, f"{time:.6f}"]
            for hand, numbers in zip(take.hands, values, strict=True):
                row += [str(int(hand.seen[index])), str(int(hand.bridged[index]))]
                row += _cells(numbers[index], how)
            table.writerow(row)
    return path


def _cells(numbers: Iterable[float], how: str) -> list[str]:
    return [how % number if np.isfinite(number) else "" for number in numbers]
