"""Labels of a capture: an npz with the hands of each frame, in the world of its rig.

`poem fit` and `poem reconstruct` write them (`prediction.npz`), and so may the user. F frames, H hands:

    hand_side (H,)              'left' or 'right'
    frames (F,)                 names of the frames; may be left out where there is one
    joints_world (F,H,21,3)     metres, OpenPose order; NaN = this hand has no label in this frame
    vertices_world (F,H,778,3)  metres
    pose (F,H,16,3)             axis-angle, zero = flat hand, `[0]` turns the hand into the world
    shape (F,H,10)
    translation (F,H,3)         metres, added to the posed hand
    valid (F,H), cameras (V,), reprojection_px (F,H,V)     as `poem fit` writes them; may be left out

Either joints and vertices are there (pose and shape may be), or pose, shape and translation of MANO with the
user's MANO file, and joints and vertices are made of them. Those of a long take stay on disk. To evaluate,
not to train, joints alone will do.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poem_jax.hand import mano_file
from poem_jax.hand.model import HandModel, hand_mesh, mirror
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES, NUM_SKELETON_JOINTS, NUM_VERTICES
from poem_jax.io.npz_file import read_npz
from poem_jax.io.npz_rows import NpzRows
from poem_jax.typing import Array, Float

LABEL_FILES = ("labels.npz", "prediction.npz", "fit/prediction.npz")
"""Where labels are looked for in a capture's folder."""
_SIDES = ("left", "right")
_MANO = {"pose": (NUM_SKELETON_JOINTS, 3), "shape": (NUM_SHAPES,), "translation": (3,)}
_MESH = {"joints_world": (NUM_JOINTS, 3), "vertices_world": (NUM_VERTICES, 3)}


@dataclass(frozen=True)
class CaptureLabels:
    """The hands of all frames."""

    path: Path
    sides: tuple[str, ...]
    frames: tuple[str, ...]
    joints_world: Float[Array, "frame hand 21 3"]
    """Metres; NaN where there is no label."""
    mano: Mapping[str, Array]
    """`pose`, `shape` and `translation` as far as the file has them."""
    cameras: tuple[str, ...] | None
    reprojection_px: Float[Array, "frame hand view"] | None
    _stored: NpzRows | None
    """The vertices; None = they are made of the pose."""
    _hands: Mapping[str, HandModel]
    """By side, where vertices are made."""
    joints_alone: bool = False
    """There are no vertices, and nothing to make them of."""

    def vertices(self, frame: int, hand: int) -> Float[Array, "778 3"]:
        """Return the vertices of a hand that has a label, metres in the world; NaN for `joints_alone`.

        Raises:
            OSError, ValueError: The file is gone or has changed.
        """
        if self.joints_alone:
            return np.full((NUM_VERTICES, 3), np.nan, np.float32)
        if self._stored is not None:
            return self._stored[frame][hand]
        posed = {name: values[frame, hand] for name, values in self.mano.items()}
        return hand_mesh(self._hands[self.sides[hand]], **posed).vertices

    def pose_and_shape(
        self, frame: int, hand: int
    ) -> tuple[Float[Array, "16 3"] | None, Float[Array, "10"] | None]:
        """Return pose in the world and shape of a hand; None where the file, or this hand, has none."""
        values = [self.mano.get(name) for name in ("pose", "shape")]
        rows = [None if value is None else value[frame, hand] for value in values]
        pose, shape = (row if row is not None and np.isfinite(row).all() else None for row in rows)
        return pose, shape


def find_labels(folder: Path) -> Path:
    """Return the file of labels in a capture's folder.

    Raises:
        FileNotFoundError: There is none; says how to make one.
    """
    found = next((folder / name for name in LABEL_FILES if (folder / name).is_file()), None)
    if found is None:
        raise FileNotFoundError(
            f"{folder} has no labels: expected {' or '.join(LABEL_FILES)} in it; `poem fit {folder} --out "
            f"{folder / 'fit'}` makes them from its key points"
        )
    return found


def read_labels(
    path: str | Path, *, mano: str | Path | None = None, joints_alone: bool = False
) -> CaptureLabels:
    """Read labels.

    Args:
        path: The npz.
        joints_alone: Take `joints_world` without vertices, if the file has nothing to make these of.
        mano: The user's MANO file of either side, whose mirror image serves the other; needed where the file
            has no vertices.

    Raises:
        FileNotFoundError: The file, or the MANO file, is missing.
        ValueError: A field is missing or has a wrong shape or value.
    """
    path = Path(path)
    arrays = read_npz(path, required=["hand_side"])
    sides = tuple(str(side).strip().lower() for side in arrays["hand_side"].reshape(-1))
    if not sides or not set(sides) <= set(_SIDES):
        raise ValueError(f"{path}: `hand_side (H,)` must hold 'left' or 'right'; got {list(sides)}")
    has_mesh = all(name in arrays for name in _MESH)
    has_mano = all(name in arrays for name in _MANO) and mano is not None
    joints_alone = joints_alone and not (has_mesh or has_mano) and "joints_world" in arrays
    needed = {"joints_world": _MESH["joints_world"]} if joints_alone else _MESH if has_mesh else _MANO
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise ValueError(
            f"{path} must hold {' and '.join(_MESH)}, or {', '.join(_MANO)} of MANO; missing: "
            f"{', '.join(missing)}; found: {', '.join(sorted(arrays))}"
        )
    count = len(arrays[next(iter(needed))])
    tails = {name: tail for name, tail in {**_MESH, **_MANO}.items() if name in arrays}
    for name, tail in tails.items():
        expected = (count, len(sides), *tail)
        if arrays[name].shape != expected or arrays[name].dtype.kind != "f":
            raise ValueError(
                f"{path}: `{name}` must have shape (frame, hand, ...) = {expected} of floats; got "
                f"{arrays[name].shape} of {arrays[name].dtype}"
            )
    parameters = {name: arrays[name].astype(np.float32) for name in _MANO if name in arrays}
    hands = {} if has_mesh or joints_alone else _hands_of(path, mano)
    joints = _joints(parameters, hands, sides) if hands else arrays["joints_world"]
    if "valid" in arrays:
        valid = _shaped(arrays["valid"], "valid", (count, len(sides)), path).astype(bool)
        joints = np.where(valid[..., None, None], joints, np.nan)
    if "bridged" in arrays:
        # Put between the moments before and after, not seen.
        bridged = _shaped(arrays["bridged"], "bridged", (count, len(sides)), path).astype(bool)
        joints = np.where(bridged[..., None, None], np.nan, joints)
    return CaptureLabels(
        path,
        sides,
        _frame_names(arrays, count, path),
        joints,
        parameters,
        tuple(str(name) for name in arrays["cameras"]) if "cameras" in arrays else None,
        arrays.get("reprojection_px"),
        NpzRows(path, "vertices_world") if has_mesh else None,
        hands,
        joints_alone,
    )


def _hands_of(path: Path, mano: str | Path | None) -> dict[str, HandModel]:
    if mano is None:
        raise ValueError(
            f"{path} holds {', '.join(_MANO)} but no vertices: say which MANO file they belong to (`mano`)"
        )
    own = mano_file.load(mano)
    other = HandModel(*(np.asarray(array) for array in mirror(own)))
    return {own.side: own, other.side: other}


def _joints(
    parameters: Mapping[str, Array], hands: Mapping[str, HandModel], sides: tuple[str, ...]
) -> Float[Array, "frame hand 21 3"]:
    posed = [
        hand_mesh(hands[side], **{name: values[:, i] for name, values in parameters.items()}).joints
        for i, side in enumerate(sides)
    ]
    return np.stack(posed, 1)


def _frame_names(arrays: Mapping[str, Array], count: int, path: Path) -> tuple[str, ...]:
    if "frames" in arrays:
        return tuple(str(name) for name in _shaped(arrays["frames"], "frames", (count,), path))
    if count != 1:
        raise ValueError(f"{path} has {count} frames: add `frames (F,)` with their names")
    return ("0000",)


def _shaped(array: Array, name: str, shape: tuple[int, ...], path: Path) -> Array:
    if array.shape != shape:
        raise ValueError(f"{path}: `{name}` must have shape {shape}; got {array.shape}")
    return array
