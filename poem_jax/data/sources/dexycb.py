"""DexYCB (Chao et al., CVPR 2021): eight calibrated cameras, 10 subjects who grasp and hand over objects.

Layout, as released (dex-ycb.github.io; dex-ycb-toolkit):

    DexYCB/<date>-subject-NN/<date_time>/{meta.yml, <serial>/{color,labels}_%06d.{jpg,npz}}
    DexYCB/calibration/{extrinsics_<id>/extrinsics.yml, intrinsics/<serial>_640x480.yml, mano_<id>/mano.yml}

Conventions of the set: metres; joints in OpenPose order; extrinsics map a *camera to the master*; fingers are
45 coefficients of MANO's components about its mean; MANO's layer without centring, then a translation; pixels
have their origin at the centre of the first pixel (RealSense's), so K and key points get + 0.5.

A multi-view frame is an instant of a sequence in all views that show the hand (no `joint_2d` is -1). The
camera 840412060917 is first; instants that it does not show are left out and counted. Paper: 25,387 / 1,412
/ 4,951 frames for s0's train / val / test, before any are left out; the released tars hold 4,950 of the last.

Left hands were labelled with the MANO_LEFT.pkl that was published, whose shape directions are faulty
(`hand/mano_file.py`). Where only they give a sequence's labelled joints, its frames have no `shape`: its
coefficients are not those of the mended hand, nor of the right one.
"""

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from poem_jax.data.frames import CorruptSampleError, MultiViewFrame, check_frame
from poem_jax.data.right_hand import as_right_hand
from poem_jax.data.sources.dexycb_files import (
    ADVICE,
    HEIGHT,
    LABEL_SHAPES,
    SERIALS,
    WIDTH,
    read_extrinsics,
    read_intrinsics,
    read_sequences,
    views_with_hand,
)
from poem_jax.data.sources.hand_in_views import ManoFile, span_intrinsics, span_pixels
from poem_jax.data.sources.label_npz import read_label_arrays
from poem_jax.data.sources.raw_sets import (
    check_choice,
    check_count,
    check_mesh,
    find_folder,
    identify_list,
    read_image,
)
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.hand.model import HandMesh
from poem_jax.typing import Array, Bool, Float

SETUPS = ("s0", "s1", "s3")
SPLITS = ("train", "val", "test")
MASTER = "840412060917"
PAPER_COUNTS = {("s0", "train"): 25_387, ("s0", "val"): 1_412, ("s0", "test"): 4_951}
_MASTER_VIEW = SERIALS.index(MASTER)
_UNSEEN_CAMERAS = "s2 keeps whole cameras apart for the test, so that its frames have but one view"
_SHAPE_SIGN = np.array([-1, 1, 1], np.float32)[:, None]

_log = logging.getLogger(__name__)


class DexYCB:
    """One split of DexYCB as multi-view frames of right hands."""

    def __init__(
        self,
        root: str | Path,
        *,
        split: str = "train",
        setup: str = "s0",
        mano: str | Path,
        left: bool = False,
        mano_left: str | Path | None = None,
        strict_counts: bool = False,
    ) -> None:
        """List the split. The first time, the key points of all its labels are read (minutes), then cached.

        Args:
            root: The folder `DexYCB`, or the one that holds it.
            split: "train", "val" or "test".
            setup: "s0" (all seen; the paper's), "s1" (unseen subjects) or "s3" (unseen objects).
            mano: The user's `MANO_RIGHT.pkl`.
            left: Also take sequences of left hands, as the right hands that a mirror shows; those whose
                labels need the published file's faulty shape directions have `shape` None.
            mano_left: The user's `MANO_LEFT.pkl`, needed for those.
            strict_counts: Insist on the paper's number of frames, and on 100 sequences of each subject.

        Raises:
            FileNotFoundError: No such folder, or it lacks a calibration or the split; no MANO file.
            ValueError: Another setup or split, a damaged calibration, a MANO file of the wrong side.
        """
        check_choice("setup", setup, SETUPS, why={"s2": _UNSEEN_CAMERAS})
        check_choice("split", split, SPLITS)
        self.root = find_folder(root, ("DexYCB", "dex-ycb", "dexycb"), "calibration", advice=ADVICE)
        self.name = f"dexycb {setup} {split}"
        self.max_views = len(SERIALS)
        self._mano = {"right": ManoFile.open(mano)}
        if left:
            if mano_left is None:
                raise ValueError("left hands need `mano_left`, the path of MANO_LEFT.pkl; got None")
            self._mano["left"] = ManoFile.open(mano_left, side="left")
        sequences = read_sequences(self.root, setup, split, strict=strict_counts)
        self._sequences = [sequence for sequence in sequences if sequence.side in self._mano]
        self._K = span_intrinsics(read_intrinsics(self.root))
        ids = {sequence.extrinsics for sequence in self._sequences}
        self._T_master_from_cam = {name: read_extrinsics(self.root, name) for name in sorted(ids)}
        self._index, dropped = self._list_frames()
        paper = None if left else PAPER_COUNTS.get((setup, split))
        check_count(self.name, len(self) + dropped, paper, strict=strict_counts)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> MultiViewFrame:
        """Read one frame.

        Raises: CorruptSampleError: a file of it is missing or damaged, or its labels cannot be true.
        """
        number, frame, *shown = (int(value) for value in self._index[index])
        sequence = self._sequences[number]
        views = [_MASTER_VIEW, *(v for v in range(len(SERIALS)) if shown[v] and v != _MASTER_VIEW)]
        key = f"{sequence.name}/{frame:06d}"
        mano, folder = self._mano[sequence.side], self.root / sequence.name
        paths = [folder / SERIALS[v] / f"labels_{frame:06d}.npz" for v in views]
        labels = [_read_label(path, key) for path in paths]
        pose_m = np.concatenate([label["pose_m"] for label in labels])
        joints = np.concatenate([label["joint_3d"] for label in labels])
        pose = mano.components.pose(pose_m[:, :3], pose_m[:, 3:48])
        shape = np.tile(sequence.betas, (len(views), 1))
        mesh, is_shape_ours = self._mesh(sequence.side, pose, shape, pose_m[:, 48:], joints)
        for v, path in enumerate(paths):
            check_mesh(mesh.joints[v : v + 1], joints[v : v + 1], path, key)
        T = invert_rigid(self._T_master_from_cam[sequence.extrinsics][views])
        made = MultiViewFrame(
            key=key,
            images=tuple(read_image(folder / SERIALS[v] / f"color_{frame:06d}.jpg", key) for v in views),
            view_names=tuple(SERIALS[v] for v in views),
            size_wh=np.tile([WIDTH, HEIGHT], (len(views), 1)),
            K=self._K[views],
            T_cam_from_world=T,
            joints_cam=joints,
            vertices_cam=mesh.vertices,
            keypoints_px=span_pixels(np.concatenate([label["joint_2d"] for label in labels])),
            pose_cam=pose.astype(np.float32),
            shape=shape if is_shape_ours else None,
        )
        made = check_frame(made, folder)
        return made if sequence.side == "right" else as_right_hand(made)

    def fingerprint(self) -> Mapping[str, str]:
        """Return what identifies the list of samples."""
        keys = (f"{self._sequences[row[0]].name} {row[1:].tolist()}" for row in self._index)
        return {f"{self.root}, {self.name}": identify_list(keys)}

    def _list_frames(self) -> tuple[Array, int]:
        """Return rows of sequence, frame, and for each camera whether it shows the hand (0 or 1); and how
        many more the master does not show.

        Frames come in the order in which the release's reader first sees them: those of the first camera that
        shows them before those of the next.
        """
        rows, dropped = [np.zeros((0, 2 + len(SERIALS)), np.int32)], 0
        for number, sequence in enumerate(self._sequences):
            shown = views_with_hand(self.root, sequence)
            frames = _first_seen_order(shown)
            kept = frames[shown[_MASTER_VIEW, frames]]
            dropped += len(frames) - len(kept)
            rows.append(
                np.column_stack([np.full_like(kept, number), kept, shown[:, kept].T]).astype(np.int32)
            )
        if dropped:
            _log.warning("%s: %d frames are left out, as camera %s shows no hand", self.name, dropped, MASTER)
        return np.concatenate(rows), dropped

    def _mesh(
        self,
        side: str,
        pose: Float[Array, "view 16 3"],
        shape: Float[Array, "view 10"],
        translation: Float[Array, "view 3"],
        joints: Float[Array, "view 21 3"],
    ) -> tuple[HandMesh, bool]:
        """Run MANO; tell, too, whether the hand is that of the file as we read it.

        The shape directions of the published left hand were faulty when the set was labelled, and
        `mano_file.load` mends them: of both readings the one that gives the labelled joints is taken.
        """
        mano = self._mano[side]
        mesh = mano.mesh(pose, shape, translation)
        if side == "right":
            return mesh, True
        as_published = mano.hand._replace(shapedirs=mano.hand.shapedirs * _SHAPE_SIGN)
        other = mano.mesh(pose, shape, translation, hand=as_published)
        apart, apart_other = (float(np.abs(made.joints - joints).max()) for made in (mesh, other))
        return (other, False) if apart_other < apart else (mesh, True)


def _first_seen_order(shown: Bool[Array, "camera frame"]) -> Array:
    seen = shown.any(0)
    first = shown.argmax(0)
    frames = np.flatnonzero(seen)
    return frames[np.argsort(first[frames], kind="stable")]


def _read_label(path: Path, key: str) -> dict[str, Array]:
    try:
        return read_label_arrays(path, LABEL_SHAPES)
    except ValueError as error:
        raise CorruptSampleError(path, key, str(error)) from error
