"""ARCTIC: two hands and an articulated object before eight cameras that stand still, protocol p1.

Layout (the set's own documentation and code, github.com/zc-alexfan/arctic, docs/data/data_doc.md,
src/arctic/processing.py and split.py), below `arctic_data/data/`: `splits_json/protocol_p1.json` (lists of
"<subject>/<sequence>"), `raw_seqs/<subject>/<sequence>.mano.npy` (a dict: for "right" and "left" `rot`
(n, 3), `pose` (n, 45), `trans` (n, 3), `shape` (10)), `meta/misc.json` (for each subject `world2cam`,
`intris_mat`, `image_size`, `ioi_offset`) and `images/<subject>/<sequence>/<view>/<number:05d>.jpg`.

Conventions: view 0 is the moving camera on the head, which p1 leaves out; views 1..8 belong to
`world2cam[0..7]` and `intris_mat[0..7]`, but to `image_size[1..8]`. The hand of image number n is row
n - `ioi_offset`. The first and last ten numbers are left out (the images may be black). Vertices are MANO's
with `flat_hand_mean` False and `trans` added, in the world, metres. The 21 joints are smplx's: 16 skeleton
joints and its own five tip vertices, which are not those of manotorch's layer. Pixels count from the centre
of the first, so K gets half a pixel here.
"""

import functools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.data.frames import CorruptSampleError, MultiViewFrame, check_frame
from poem_jax.data.right_hand import as_right_hand
from poem_jax.data.sources.hand_in_views import ManoFile, hand_in_views, span_intrinsics
from poem_jax.data.sources.raw_sets import (
    check_choice,
    check_count,
    find_folder,
    identify,
    identify_list,
    need_file,
    numbers,
    read_image,
)
from poem_jax.geometry.cameras import project_cam
from poem_jax.hand.model import HandMesh
from poem_jax.hand.topology import SKELETON_FROM_OPENPOSE, openpose_joints
from poem_jax.io.json_file import read_json
from poem_jax.io.npy_dict import load_npy_dict
from poem_jax.typing import Array, Float, Int

VIEW_NAMES = tuple(str(view) for view in range(1, 9))
"""The allocentric cameras."""
SMPLX_TIPS = (744, 320, 443, 554, 671)
"""Tip vertices, thumb to little finger, that smplx appends to MANO's skeleton (`smplx/vertex_ids.py`)."""
_DROPPED = 10
"""Numbers at either end of a sequence."""
_ADVICE = (
    "ARCTIC is at arctic.is.tue.mpg.de; unpack its data as arctic_data/data "
    "(raw_seqs, meta, splits_json, images)."
)
_PAPER = {("right", "train"): 135_271, ("right", "val"): 17_392}
_WHY = {"test": "the labels of the test subject are not public"}
_WHY_SETUP = {"p2": "its one camera, on the head, moves: there is no second view"}


class Arctic:
    """One split of ARCTIC's protocol p1, one hand of it; see the module."""

    max_views = len(VIEW_NAMES)

    def __init__(
        self,
        root: str | Path,
        *,
        split: str = "train",
        setup: str = "p1",
        mano: str | Path,
        hand: str = "right",
        strict_counts: bool = False,
    ) -> None:
        """Open the set and list its samples.

        Args:
            root: The folder that holds `raw_seqs/`, or one that holds it as `arctic_data/data`.
            split: "train" or "val" (the paper's test set).
            setup: "p1".
            mano: The user's MANO_RIGHT.pkl; for left hands MANO_LEFT.pkl.
            hand: "right" (the paper's), or "left": the left hands, given as right ones (`as_right_hand`).
                Their shapes were fitted with the published MANO_LEFT.pkl, whose known fault
                `hand/mano_file.py` mends: their vertices are off by what the fault makes of the shape.
            strict_counts: Raise where the count differs from the paper's.

        Raises:
            FileNotFoundError: A folder or file is missing; only cropped images count as none.
            ValueError: An unknown option, or a file of the set that is not as it should be.
        """
        check_choice("split", split, ("train", "val"), why=_WHY)
        check_choice("setup", setup, ("p1",), why=_WHY_SETUP)
        check_choice("hand", hand, ("right", "left"))
        names = ("arctic_data/data", "data/arctic_data/data", "data", "Arctic/arctic_data/data")
        self._folder = find_folder(root, names, "raw_seqs", advice=_ADVICE)
        _need_images(self._folder)
        self._mano, self._hand = ManoFile.open(mano, side=hand), hand
        self._protocol = need_file(
            self._folder / "splits_json" / f"protocol_{setup}.json", "the protocol", advice=_ADVICE
        )
        self._sequences = _read_protocol(self._protocol, split)
        self._misc = need_file(self._folder / "meta" / "misc.json", "the cameras' file", advice=_ADVICE)
        self._rigs = _read_rigs(self._misc, {sequence.split("/")[0] for sequence in self._sequences})
        self._first, self._starts = self._number_samples()
        self.name = f"arctic {setup} {split}{'' if hand == 'right' else ' left hands'}"
        check_count(self.name, len(self), _PAPER.get((hand, split)), strict=strict_counts)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> MultiViewFrame:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has samples 0 to {len(self) - 1}; got {index}")
        which = int(np.searchsorted(self._starts, index, side="right")) - 1
        sequence, number = self._sequences[which], int(self._first[which] + index - self._starts[which])
        key, path = f"{sequence}/{number:05d}", self._mano_path(sequence)
        rig = self._rigs[sequence.split("/")[0]]
        labels = _read_hand(path, self._hand, key)
        row = number - rig.ioi_offset
        pose = self._mano.add_mean(np.concatenate([labels.rot[row], labels.pose[row]]))
        shape = labels.shape[row % len(labels.shape)]
        mesh = self._mano.mesh(pose, shape, labels.trans[row])
        views = hand_in_views(rig.T_cam_from_world, _joints(mesh), mesh.vertices, pose, shape)
        folder = self._folder / "images" / sequence
        frame = MultiViewFrame(
            key=key,
            images=tuple(read_image(folder / view / f"{number:05d}.jpg", key) for view in VIEW_NAMES),
            view_names=VIEW_NAMES,
            size_wh=rig.size_wh,
            K=rig.K,
            T_cam_from_world=rig.T_cam_from_world,
            joints_cam=views.joints_cam,
            vertices_cam=views.vertices_cam,
            keypoints_px=project_cam(rig.K, views.joints_cam),
            pose_cam=views.pose_cam,
            shape=views.shape,
        )
        return check_frame(frame if self._hand == "right" else as_right_hand(frame), path)

    def fingerprint(self) -> dict[str, str]:
        """Return what identifies the list of samples."""
        counts = np.diff(self._starts)
        keys = (
            f"{name} {first} {n}" for name, first, n in zip(self._sequences, self._first, counts, strict=True)
        )
        return {
            str(self._protocol): identify(self._protocol),
            str(self._misc): identify(self._misc),
            "sequences": identify_list(keys),
        }

    def _mano_path(self, sequence: str) -> Path:
        return self._folder / "raw_seqs" / f"{sequence}.mano.npy"

    def _number_samples(self) -> tuple[Int[Array, " sequence"], Int[Array, " start"]]:
        """Return the first image number of each sequence, and the index of its first sample; one more at the
        end."""
        first, counts = [], []
        for sequence in self._sequences:
            path = need_file(self._mano_path(sequence), f"the hands of {sequence}", advice=_ADVICE)
            rows, offset = _count_rows(path, self._hand), self._rigs[sequence.split("/")[0]].ioi_offset
            first.append(max(_DROPPED, offset))
            counts.append(max(0, min(rows - _DROPPED, rows + offset) - first[-1]))
        return np.array(first), np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


class _Rig(NamedTuple):
    """The cameras of one subject, views 1..8."""

    K: Float[Array, "view 3 3"]
    T_cam_from_world: Float[Array, "view 4 4"]
    size_wh: Int[Array, "view 2"]
    ioi_offset: int
    """Number of the image that shows row 0."""


class _Hand(NamedTuple):
    """One hand of a sequence, as stored."""

    rot: Float[Array, "row 3"]
    pose: Float[Array, "row 45"]
    trans: Float[Array, "row 3"]
    shape: Float[Array, "one 10"]
    """One row, or one for each frame."""


_HAND_NUMBERS = {"rot": 3, "pose": 45, "trans": 3, "shape": 10}


def _joints(mesh: HandMesh) -> Float[Array, "21 3"]:
    skeleton = mesh.joints[np.array(SKELETON_FROM_OPENPOSE)]
    return openpose_joints(skeleton, mesh.vertices[np.array(SMPLX_TIPS)])


def _need_images(folder: Path) -> None:
    if (folder / "images").is_dir():
        return
    cropped = (
        " `cropped_images` cannot serve: how they were cut is not stored in them."
        * (folder / "cropped_images").is_dir()
    )
    raise FileNotFoundError(f"the full images are missing: expected {folder / 'images'}.{cropped} {_ADVICE}")


def _read_protocol(path: Path, split: str) -> list[str]:
    """Return the sequences of a split; those of val and test are not in train, whatever its list says."""
    lists = read_json(path, what="protocol")
    for name in ("train", "val", "test"):
        if not isinstance(lists, dict) or not _is_sequences(lists.get(name)):
            raise ValueError(f'{path} must have a list of "<subject>/<sequence>" under `{name}`')
    held_out = set(lists["val"]) | set(lists["test"])
    chosen = [s for s in lists["train"] if s not in held_out] if split == "train" else lists["val"]
    if not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(f"{path}: the sequences of {split} must be some, each once; got {len(chosen)}")
    return list(chosen)


def _is_sequences(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(s, str) and s.count("/") == 1 and all(part.strip(".") for part in s.split("/"))
        for s in value
    )


def _read_rigs(path: Path, subjects: set[str]) -> dict[str, _Rig]:
    misc = read_json(path, what="file of cameras")
    rigs = {}
    for subject in sorted(subjects):
        held = misc.get(subject) if isinstance(misc, dict) else None
        if not isinstance(held, dict):
            raise ValueError(f"{path} must describe the cameras of subject {subject}; it does not")
        parts = [
            numbers(held.get(name, []), shape, f"{path}: `{name}` of {subject}")
            for name, shape in (("intris_mat", (8, 3, 3)), ("world2cam", (8, 4, 4)), ("image_size", (9, 2)))
        ]
        offset = held.get("ioi_offset")
        if type(offset) is not int:
            raise ValueError(f"{path}: `ioi_offset` of {subject} must be a whole number; got {offset!r}")
        K, T, size = parts
        rigs[subject] = _Rig(span_intrinsics(K), T, size[1:].astype(np.int64), offset)
    return rigs


def _count_rows(path: Path, hand: str) -> int:
    try:
        return len(_read_hand(path, hand, path.name.partition(".")[0]).rot)
    except CorruptSampleError as error:
        raise ValueError(str(error)) from error


def _read_hand(path: Path, hand: str, key: str) -> _Hand:
    """Return the labels of one hand of a sequence; sequences are kept, until their file changes."""
    try:
        return _parse_hand(path, hand, path.stat().st_mtime_ns)
    except (ValueError, OSError) as error:
        raise CorruptSampleError(path, key, str(error)) from error


@functools.lru_cache(maxsize=16)
def _parse_hand(path: Path, hand: str, mtime_ns: int) -> _Hand:
    held = load_npy_dict(path).get(hand)
    arrays = {}
    for name, width in _HAND_NUMBERS.items():
        value = held.get(name) if isinstance(held, dict) else None
        array = np.asarray([] if value is None else value)
        if array.dtype.kind not in "fiu" or array.ndim > 2 or array.size == 0 or array.shape[-1] != width:
            raise ValueError(f"`{hand}` must have `{name}` with rows of {width} numbers; got {array.shape}")
        arrays[name] = np.atleast_2d(array).astype(np.float32)
    rows = {len(arrays[name]) for name in ("rot", "pose", "trans")}
    if len(rows) > 1 or len(arrays["shape"]) not in (1, *rows):
        raise ValueError(f"the fields of `{hand}` differ in their number of rows")
    return _Hand(**arrays)
