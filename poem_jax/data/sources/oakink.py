"""OakInk-Image: one or two right hands and an object before four cameras, 848 x 480 PNGs.

Layout (the set's own documentation, github.com/oakink/OakInk, docs/datasets.md), below `image/`:
`stream_release_v2/<pk>/<view>_<fid>.png` with pk = "seqcat/timestamp"; `anno/split/split{0,1,2}/seq_*.json`,
`anno/split_train_val/split*/example_split_*.json`: lists of [pk, sid, fid, vid]; and `anno/{cam_intr, hand_j,
hand_v, general_info}/<infostr>.pkl` for each, infostr = these four joined by "__". Made from it by the set's
toolkit, and taken instead where they are: `anno_mv/` (the same lists with all four cameras of every hand) and
`anno_packed_mv/<subject|object>/<split>/<infostr>.pkl` (all labels of a view in one file).

Conventions: `hand_j` (OpenPose order) and `hand_v` are metres in each camera's frame; `cam_extr` maps world
to camera; the pose is 16 quaternions wxyz in the world, zero = flat hand (manotorch's layer with its default,
`flat_hand_mean` True); pixels count from the centre of the first, so K gets half a pixel here. Key points are
the projected joints. A hand-over shows two people's right hands, told apart by sid: each is a sample.

Paper: 58,692 frames for SP2's train+val and 19,909 for its test; the released tars hold 21,351 of the test.
"""

from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.data.frames import CorruptSampleError, MultiViewFrame, check_frame
from poem_jax.data.sources.hand_in_views import span_intrinsics, turn_root
from poem_jax.data.sources.raw_sets import (
    check_choice,
    check_count,
    find_folder,
    identify,
    identify_list,
    need_file,
    read_image,
)
from poem_jax.geometry.cameras import project_cam
from poem_jax.io.json_file import read_json
from poem_jax.io.tensor_pickle import load_tensors_pickle
from poem_jax.typing import Array, Float

VIEW_NAMES = ("north_east_color", "south_east_color", "north_west_color", "south_west_color")
"""By vid; the first is the constant master camera."""
SIZE_WH = (848, 480)
_VIEWS = len(VIEW_NAMES)
_QUARTER = 4
_ADVICE = "OakInk-Image is at www.oakink.net (image/anno, image/stream_release_v2)."
_SETUPS = {"SP0": ("split0", "default"), "SP1": ("split1", "subject"), "SP2": ("split2", "object")}
"""Folder of the lists, and the toolkit's word for it in `anno_packed_mv`."""
_SPLITS = {
    "train+val": ("split", "seq_train.json"),
    "train": ("split_train_val", "example_split_train.json"),
    "val": ("split_train_val", "example_split_val.json"),
    "test": ("split", "seq_test.json"),
}
_PAPER = {("SP2", "train+val"): 58_692, ("SP2", "test"): 19_909}


class OakInk:
    """One split of OakInk-Image: every hand of every frame, in four views; see the module."""

    max_views = _VIEWS

    def __init__(
        self,
        root: str | Path,
        *,
        split: str = "train+val",
        setup: str = "SP2",
        quarter: bool = False,
        mano: str | Path | None = None,
        strict_counts: bool = False,
    ) -> None:
        """Open the set and list its samples.

        Args:
            root: The folder that holds `image/`, or one that holds it as `OakInk`.
            split: "train+val" (the paper's training set), "train", "val" or "test", as the set's toolkit
                names them; "train_val" is "train+val".
            setup: "SP2" (by objects, the paper's), "SP1" (by subjects) or "SP0" (by views: the same hands in
                training and test).
            quarter: Keep every fourth sample, as the released v1 recipes do.
            mano: Not needed: vertices are stored. Taken so that all sets open alike.
            strict_counts: Raise where the count differs from the paper's.

        Raises:
            FileNotFoundError: A folder or list is missing.
            ValueError: An unknown split or setup, a list that is none, a hand without all four cameras.
        """
        split = "train+val" if split == "train_val" else split
        check_choice("split", split, _SPLITS)
        check_choice("setup", setup, _SETUPS)
        self._image = find_folder(root, ("OakInk",), "image/stream_release_v2", advice=_ADVICE) / "image"
        self._list = self._find_list(split, setup)
        packed = self._image / "anno_packed_mv" / _SETUPS[setup][1] / split
        self._packed = packed if packed.is_dir() else None
        if self._packed is None and not (self._image / "anno" / "general_info").is_dir():
            raise FileNotFoundError(
                f"labels are missing: expected {self._image / 'anno' / 'general_info'}. {_ADVICE}"
            )
        self.name = f"oakink {setup} {split}{' quarter' if quarter else ''}"
        samples = _read_list(self._list)
        check_count(f"oakink {setup} {split}", len(samples), _PAPER.get((setup, split)), strict=strict_counts)
        self._samples = samples[::_QUARTER] if quarter else samples

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> MultiViewFrame:
        pk, sid, fid = self._samples[index]
        key = f"{pk}/{sid}/{fid}"
        folder = self._image / "stream_release_v2" / pk
        labels = [
            self._read_labels(f"{pk.replace('/', '__')}__{sid}__{fid}__{v}", key) for v in range(_VIEWS)
        ]
        K, T, joints, vertices, poses, shapes = (np.stack(parts) for parts in zip(*labels, strict=True))
        K = span_intrinsics(K)
        frame = MultiViewFrame(
            key=key,
            images=tuple(read_image(folder / f"{name}_{fid}.png", key) for name in VIEW_NAMES),
            view_names=VIEW_NAMES,
            size_wh=np.tile(np.array(SIZE_WH), (_VIEWS, 1)),
            K=K,
            T_cam_from_world=T,
            joints_cam=joints,
            vertices_cam=vertices,
            keypoints_px=project_cam(K, joints),
            pose_cam=poses,
            shape=shapes,
        )
        return check_frame(frame, folder)

    def fingerprint(self) -> dict[str, str]:
        """Return what identifies the list of samples."""
        keys = (f"{pk}/{sid}/{fid}" for pk, sid, fid in self._samples)
        return {str(self._list): identify(self._list), "samples": identify_list(keys)}

    def _find_list(self, split: str, setup: str) -> Path:
        kind, name = _SPLITS[split]
        part = Path(kind, _SETUPS[setup][0], name)
        extended = self._image / "anno_mv" / part
        if extended.is_file():
            return extended
        return need_file(self._image / "anno" / part, f"the list of {setup} {split}", advice=_ADVICE)

    def _read_labels(self, infostr: str, key: str) -> tuple[Array, ...]:
        """Return K (as stored), T_cam_from_world, joints, vertices, pose and shape of one view."""
        if self._packed is not None:
            path = self._packed / f"{infostr}.pkl"
            held = _load(path, key)
            return tuple(_field(held, name, shape, path, key) for name, shape in _PACKED.items())
        anno, name = self._image / "anno", f"{infostr}.pkl"
        path = anno / "general_info" / name
        info = _load(path, key)
        T = _field(info, "cam_extr", (4, 4), path, key)
        hand = info.get("hand_anno")
        quaternions = _field(hand, "hand_pose", (16, 4), path, key)
        pose = turn_root(_axis_angles(quaternions, path, key), T[:3, :3])
        K, joints, vertices = (
            _checked(_load(anno / part / name, key), part, shape, anno / part / name, key)
            for part, shape in (("cam_intr", (3, 3)), ("hand_j", (21, 3)), ("hand_v", (778, 3)))
        )
        return K, T, joints, vertices, pose, _field(hand, "hand_shape", (10,), path, key)


_PACKED = {
    "cam_intr": (3, 3),
    "cam_extr": (4, 4),
    "hand_j": (21, 3),
    "hand_v": (778, 3),
    "mano_pose": (16, 3),
    "mano_shape": (10,),
}
"""Fields of `anno_packed_mv` in the order of `_read_labels`; the pose's wrist is in the camera's frame."""


def _read_list(path: Path) -> list[tuple[str, int, int]]:
    """Return (pk, sid, fid) of the samples. The set's own lists name the views that show half of a hand;
    every hand in them is taken with all four views, sorted, as its toolkit does for `anno_mv`."""
    entries = read_json(path, what="list of samples")
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path} must be a list of samples [pk, sid, fid, vid] that is not empty")
    views: dict[tuple[str, int, int], set[int]] = {}
    for i, entry in enumerate(entries):
        if not _is_entry(entry):
            raise ValueError(
                f"{path}, entry {i}: expected [pk, sid, fid, vid] with vid 0..{_VIEWS - 1}; got "
                f"{str(entry)[:80]}"
            )
        views.setdefault((entry[0], entry[1], entry[2]), set()).add(entry[3])
    if "anno_mv" not in path.parts:
        return sorted(views)
    for sample, found in views.items():
        if len(found) < _VIEWS:
            raise ValueError(
                f"{path}: all {_VIEWS} views of a hand must be listed; {sample} has {sorted(found)}. "
                "Make the list again with the toolkit, or remove it: the set's own is read then"
            )
    return list(views)


def _is_entry(entry: Any) -> bool:
    if not isinstance(entry, list) or len(entry) != 4 or not isinstance(entry[0], str):
        return False
    parts = entry[0].split("/")
    plain = len(parts) == 2 and all(part not in ("", ".", "..") for part in parts)
    return plain and all(type(n) is int and n >= 0 for n in entry[1:]) and entry[3] < _VIEWS


def _load(path: Path, key: str) -> Any:
    try:
        return load_tensors_pickle(path)
    except (OSError, ValueError) as error:
        raise CorruptSampleError(path, key, str(error)) from error


def _field(held: Any, name: str, shape: tuple[int, ...], path: Path, key: str) -> Float[Array, "..."]:
    if not isinstance(held, dict) or name not in held:
        raise CorruptSampleError(path, key, f"it must have the field `{name}`")
    return _checked(held[name], name, shape, path, key)


def _checked(value: Any, name: str, shape: tuple[int, ...], path: Path, key: str) -> Float[Array, "..."]:
    """Return numbers of a shape; flat ones are arranged (poses are kept flat in some files)."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise CorruptSampleError(path, key, f"`{name}` must be numbers of shape {shape}; {error}") from error
    if array.dtype.kind not in "fiu" or array.size != np.prod(shape):
        raise CorruptSampleError(
            path, key, f"`{name}` must be numbers of shape {shape}; got {array.shape} of {array.dtype}"
        )
    return array.reshape(shape).astype(np.float64)


def _axis_angles(q: Float[Array, "*batch 4"], path: Path, key: str) -> Float[Array, "*batch 3"]:
    """Return the axis-angle vectors, at most pi long, of quaternions wxyz of any length but 0."""
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not (norm > 1e-6).all():
        raise CorruptSampleError(path, key, "`hand_pose` holds a quaternion that is no rotation")
    q = q / norm * np.where(q[..., :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    small = sine < 1e-8
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(small, 2.0, angle / np.where(small, 1.0, sine))
