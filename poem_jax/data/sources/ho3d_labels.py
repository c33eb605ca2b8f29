"""HO-3D's label files: those of single views, and those that were held out and published apart."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources.annotation_cache import json_rows
from poem_jax.data.sources.hand_in_views import ManoFile, turn_root
from poem_jax.data.sources.raw_sets import check_mesh
from poem_jax.hand.topology import (
    NUM_JOINTS,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    NUM_VERTICES,
    OPENPOSE_FROM_MANO,
)
from poem_jax.io.safe_pickle import load_arrays_pickle
from poem_jax.typing import Array, Float

ADVICE = (
    "Get HO-3D from www.tugraz.at (Institute of Computer Graphics and Vision, HO-3D; for research only), and "
    "see github.com/shreyashampali/ho3d"
)
_ARCHIVE_ADVICE = (
    "POEM's authors give HO3D_v3_manual_test_gt.zip (docs/datasets.md of github.com/lixiny/POEM); HO-3D's "
    "own evaluation_xyz.json and evaluation_verts.json are linked from github.com/shreyashampali/ho3d. Put "
    "them beside the set, or name their folder with `held_out`"
)
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
_OFFICIAL = ("evaluation_xyz.json", "evaluation_verts.json")
_ROOT_APART_M = 0.05
_POSE = (NUM_SKELETON_JOINTS, 3)


class HeldOut(NamedTuple):
    """The labels of an evaluation image: OpenCV axes, OpenPose order, metres."""

    joints_cam: Float[Array, "21 3"]
    vertices_cam: Float[Array, "778 3"]
    pose_cam: Float[Array, "16 3"] | None
    shape: Float[Array, "10"] | None


class ViewLabel(NamedTuple):
    """The labels of one image: OpenCV axes, OpenPose order, metres."""

    joints_cam: Float[Array, "21 3"]
    vertices_cam: Float[Array, "778 3"]
    pose_cam: Float[Array, "16 3"] | None
    shape: Float[Array, "10"] | None
    K_index: Float[Array, "3 3"]
    """As stored: pixel (0, 0) is a pixel's centre."""
    box_index: Float[Array, "4"] | None
    """As stored."""


class HeldOutLabels(NamedTuple):
    """Labels of evaluation images: POEM's archive of single files, or the authors' two lists."""

    archive: Path | None
    official: tuple[Path, Path] | None

    @classmethod
    def find(cls, root: Path, version: str, folder: str | Path | None, *, need: str) -> "HeldOutLabels":
        """Look for the labels.

        Args:
            root: The set's folder.
            version: "v2" or "v3".
            folder: Where the user says they are; None looks within the set and beside it.
            need: "official" takes the two lists alone, "any" the archive, and the lists for what it lacks.

        Raises:
            FileNotFoundError: There are none; says where to get them.
        """
        names = (f"HO3D_{version}_manual_test_gt", f"HO3D_{version}_official_gt")
        places = [root.parent / n for n in names] + [root / n for n in names] + [root]
        places = [Path(folder)] if folder is not None else places
        archives = (place for place in places if place != root and any(place.glob("*/meta")))
        archive = next(archives, None)
        lists = (tuple(place / name for name in _OFFICIAL) for place in places)
        official = next(((xyz, verts) for xyz, verts in lists if xyz.is_file() and verts.is_file()), None)
        if official is None and (archive is None or need == "official"):
            wanted = " and ".join(_OFFICIAL) + ("" if need == "official" else ", or the archive <SEQ>/meta")
            raise FileNotFoundError(
                f"the labels of evaluation images are missing: expected {wanted} in {places[0]} (or "
                f"{', '.join(str(place) for place in places[1:])}). {_ARCHIVE_ADVICE}"
            )
        return cls(None if need == "official" else archive, official)

    def read(self, sequence: str, place: int, row: int, key: str) -> HeldOut:
        """Return the labels of one image.

        Args:
            sequence: Its sequence.
            place: Among the sequence's lines of `evaluation.txt`: the name of its file in the archive.
            row: In `evaluation.txt`: its row in the lists.
            key: Of the sample, for messages.

        Raises:
            CorruptSampleError: There are none for it, or they are damaged.
        """
        path = self.archive / sequence / "meta" / f"{place:04d}.pkl" if self.archive is not None else None
        if path is not None and (path.is_file() or self.official is None):
            label = _read_pickle(path, key)
            return HeldOut(
                _field(label, "target_joints_3d", (NUM_JOINTS, 3), path, key),
                _field(label, "target_verts_3d", (NUM_VERTICES, 3), path, key),
                _field(label, "mano_pose", _POSE, path, key),
                _field(label, "mano_shape", (NUM_SHAPES,), path, key),
            )
        assert self.official is not None
        rows = [
            json_rows(path, (n, 3)) for path, n in zip(self.official, (NUM_JOINTS, NUM_VERTICES), strict=True)
        ]
        for path, found in zip(self.official, rows, strict=True):
            if row >= len(found):
                raise CorruptSampleError(path, key, f"it has {len(found)} rows; expected one for line {row}")
        joints, vertices = (np.array(found[row], np.float64) @ OPENCV_FROM_OPENGL for found in rows)
        return HeldOut(joints[list(OPENPOSE_FROM_MANO)], vertices, None, None)


def read_view(path: Path, key: str, mano: ManoFile, held_out: HeldOut | None) -> ViewLabel:
    """Read the label file of one image.

    Args:
        path: `meta/<frame>.pkl`.
        key: Of the sample, for messages.
        mano: The user's hand.
        held_out: The labels of an evaluation image, whose own file has but camera, box and root.

    Raises:
        CorruptSampleError: It is missing or damaged, or its joints and its MANO parameters disagree.
    """
    label = _read_pickle(path, key)
    K = _field(label, "camMat", (3, 3), path, key)
    if held_out is not None:
        _check_root(label, held_out, path, key)
        box = _field(label, "handBoundingBox", (4,), path, key) if "handBoundingBox" in label else None
        return ViewLabel(*held_out, K, box)
    joints = _field(label, "handJoints3D", (NUM_JOINTS, 3), path, key) @ OPENCV_FROM_OPENGL
    pose = _field(label, "handPose", _POSE, path, key)
    shape = _field(label, "handBeta", (NUM_SHAPES,), path, key)
    mesh = mano.mesh(pose, shape, _field(label, "handTrans", (3,), path, key))
    joints = joints[list(OPENPOSE_FROM_MANO)]
    check_mesh(mesh.joints[None] @ OPENCV_FROM_OPENGL, joints[None], path, key)
    pose = turn_root(pose, OPENCV_FROM_OPENGL)
    return ViewLabel(joints, mesh.vertices @ OPENCV_FROM_OPENGL, pose, shape, K, None)


def _check_root(label: dict[str, Any], held_out: HeldOut, path: Path, key: str) -> None:
    """The wrist is in the image's own file: it tells whether the labels are those of this image."""
    root = OPENCV_FROM_OPENGL @ _field(label, "handJoints3D", (3,), path, key)
    apart = np.linalg.norm(held_out.joints_cam[0] - root)
    if not apart <= _ROOT_APART_M:
        raise CorruptSampleError(
            path,
            key,
            f"its wrist lies {apart:.3g} m from that of its held-out labels; expected at most "
            f"{_ROOT_APART_M}. The labels are of another image",
        )


def _read_pickle(path: Path, key: str) -> dict[str, Any]:
    try:
        label = load_arrays_pickle(path)
    except (OSError, ValueError) as error:
        raise CorruptSampleError(path, key, str(error)) from error
    if not isinstance(label, dict):
        raise CorruptSampleError(path, key, f"it must hold a dictionary; got a {type(label).__name__}")
    return label


def _field(label: dict[str, Any], name: str, shape: tuple[int, ...], path: Path, key: str) -> Array:
    """Return numbers of a label, as many as `shape` has."""
    if label.get(name) is None:
        raise CorruptSampleError(
            path, key, f"`{name}` is missing or None; it has {', '.join(map(str, label))}"
        )
    try:
        array = np.asarray(label[name], np.float64)
    except (TypeError, ValueError) as error:
        raise CorruptSampleError(path, key, f"`{name}` must be numbers {shape}; {error}") from error
    if array.size != np.prod(shape):
        raise CorruptSampleError(path, key, f"`{name}` must have shape {shape}; got {array.shape}")
    return array.reshape(shape)
