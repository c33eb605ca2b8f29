"""HO-3D v2 and v3 (Hampali et al., CVPR 2020; arXiv 2107.00887): hands and objects, up to five cameras.

Layout (README of github.com/shreyashampali/ho3d; v2 has PNG in the place of JPEG, and no `calibration`):

    HO3D_v3/{train,evaluation}/<SEQ>/{rgb/%04d.jpg, meta/%04d.pkl}, train.txt, evaluation.txt
    HO3D_v3/calibration/<MAIN>/calibration/{trans_0.txt .. trans_4.txt, cam_orders.txt}
    HO3D_v3_manual_test_gt/<SEQ>/meta/%04d.pkl           labels of held-out views, by POEM's authors
    {HO3D_v2_official_gt,...}/evaluation_{xyz,verts}.json  labels of the official evaluation set

Conventions of the set: metres; OpenGL axes (y up, z backwards), turned here by G = diag(1, -1, -1); joints in
MANO's order; 48 axis-angle numbers about the flat hand; MANO's layer without centring, then a translation;
pixels with their origin at a pixel's centre: K and the boxes get + 0.5, key points are projections.

Splits:

- `train`, `test`: multi-view frames (paper: 9,087 and 2,706). A sequence's last digit is its camera; ABF1,
  BB1, GSF1, MDF1, SiBF1 train, GPMF1 and SB1 test. Camera 2 is first, then 0, 1, 3, 4. Views SB11 and SB13 of
  the test lie in the official evaluation set: their labels come from the archive (or the official ones,
  without pose), and their boxes are those of the set.
- `evaluation`: the official evaluation set, single views with the set's boxes. The authors published its
  labels in November 2024: `evaluation_xyz.json` and `evaluation_verts.json`, OpenGL axes, MANO's joint order,
  in the order of `evaluation.txt`; their `eval.py` scores predictions in the same form.
- `evaluation-mv`: the same images, labels and boxes in multi-view frames: those of AP1, MPM1 and SB1 (of
  which it has cameras 1 and 3) in the order of views above, whichever are there; SM1 has one camera, which is
  the world.

Extrinsics come from `calibration`: v2 has none of its own, and takes that of `HO3D_v3` beside it, the
recordings being the same. Without that they come from the labels, which are one hand in all views; the log
says so.
"""

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from poem_jax.data.frames import MultiViewFrame, check_frame
from poem_jax.data.sources.hand_in_views import ManoFile, span_intrinsics, span_pixels
from poem_jax.data.sources.ho3d_calibration import Calibration, align_labels
from poem_jax.data.sources.ho3d_labels import ADVICE, HeldOutLabels, ViewLabel, read_view
from poem_jax.data.sources.ho3d_lists import VIEW_ORDER, Member, group_views, read_list
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
from poem_jax.typing import Array, Float

MAIN_SEQUENCES = {"train": ("ABF1", "BB1", "GSF1", "MDF1", "SiBF1"), "test": ("GPMF1", "SB1")}
SPLITS = ("train", "test", "evaluation", "evaluation-mv")
_LISTS = {"train": ("train",), "test": ("train", "evaluation")}
"""Of a split; the last two splits have but `evaluation`."""
PAPER_COUNTS = {("v3", "train"): 9_087, ("v3", "test"): 2_706}
EVALUATION_COUNTS = {"v2": 11_524, "v3": 20_137}
"""Images of the official sets, as the authors' `vis_utils.py` states them."""
WIDTH, HEIGHT = 640, 480
_SUFFIXES = {"v2": (".png", ".jpg"), "v3": (".jpg", ".png")}

_log = logging.getLogger(__name__)


class HO3D:
    """One split of HO-3D; see the module for what each holds."""

    def __init__(
        self,
        root: str | Path,
        *,
        split: str = "train",
        version: str = "v3",
        mano: str | Path,
        held_out: str | Path | None = None,
        sequences: tuple[str, ...] | None = None,
        strict_counts: bool = False,
    ) -> None:
        """List the split from the set's own lists.

        Args:
            root: The folder `HO3D_v3` (or `HO3D_v2`), or the one that holds it.
            split: "train", "test", "evaluation" or "evaluation-mv".
            version: "v2" or "v3".
            mano: The user's `MANO_RIGHT.pkl`.
            held_out: Folder of the labels of evaluation images; None looks within and beside the set.
            sequences: Main sequences of the evaluation set (`("SM1",)`) that are listed; None = all.
            strict_counts: Insist on the paper's number of frames.

        Raises:
            FileNotFoundError: No such set, list, MANO file, or labels of evaluation images where the split
                cannot do without (v2's `test` leaves these views out instead, with a warning).
            ValueError: Another split or version, or a damaged list.
        """
        check_choice("split", split, SPLITS)
        check_choice("version", version, EVALUATION_COUNTS)
        names = (f"HO3D_{version}", f"HO-3D_{version}")
        self.root = find_folder(root, names, "train.txt", advice=ADVICE)
        self.name = f"ho3d {version} {split}"
        self.max_views = 1 if split == "evaluation" else len(VIEW_ORDER)
        self._version, self._split = version, split
        self.num_images = 0
        """Lines of the list of the official evaluation set, whichever sequences are asked for."""
        self._mano = ManoFile.open(mano)
        lists = _LISTS.get(split, ("evaluation",))
        self._lists = [need_file(self.root / f"{n}.txt", "a list of samples", advice=ADVICE) for n in lists]
        members = [member for path in self._lists for member in read_list(path)]
        if split in MAIN_SEQUENCES:
            members = [member for member in members if _is_view_of(member, MAIN_SEQUENCES[split])]
            self._held_out = self._find_held_out(members, held_out)
            if self._held_out is None:
                members = [member for member in members if member.listed_in == "train"]
            self._frames = self._with_master(group_views(members))
            check_count(self.name, len(self), PAPER_COUNTS.get((version, split)), strict=strict_counts)
        else:
            self._held_out = HeldOutLabels.find(self.root, version, held_out, need="official")
            self.num_images = len(members)
            if sequences is not None:
                members = [member for member in members if member.main in sequences]
            self._frames = [(m,) for m in members] if split == "evaluation" else group_views(members)
            check_count(
                f"{self.name}: its list",
                self.num_images,
                EVALUATION_COUNTS[version],
                strict=strict_counts,
                counted_by="the set's own count is",
            )
        self._calibrations = {} if split == "evaluation" else self._find_calibrations()

    def __len__(self) -> int:
        return len(self._frames)

    def rows(self, index: int) -> tuple[int, ...]:
        """Return of each view of a frame which line of its list it is: for the evaluation set, the place of
        its hand in a submission."""
        return tuple(member.row for member in self._frames[index])

    def __getitem__(self, index: int) -> MultiViewFrame:
        """Read one frame.

        Raises: CorruptSampleError: a file of it is missing or damaged, its labels cannot be true, or the
            hands of its views do not meet in the world.
        """
        members = self._frames[index]
        first = members[0]
        key = f"{first.sequence if self._split == 'evaluation' else first.main}/{first.frame}"
        folder = self.root / first.listed_in / first.sequence
        labels = [self._read_label(member, key) for member in members]
        joints = np.stack([label.joints_cam for label in labels])
        vertices = np.stack([label.vertices_cam for label in labels])
        K = span_intrinsics(np.stack([label.K_index for label in labels]))
        keypoints = project_cam(K, joints)
        return check_frame(
            MultiViewFrame(
                key=key,
                images=tuple(read_image(self._image_path(member), key) for member in members),
                view_names=tuple(member.view_name for member in members),
                size_wh=np.tile([WIDTH, HEIGHT], (len(members), 1)),
                K=K,
                T_cam_from_world=self._extrinsics(members, joints, key),
                joints_cam=joints.astype(np.float32),
                vertices_cam=vertices.astype(np.float32),
                keypoints_px=keypoints,
                pose_cam=_stacked([label.pose_cam for label in labels]),
                shape=_stacked([label.shape for label in labels]),
                box_px=_boxes(labels, keypoints),
            ),
            folder,
        )

    def fingerprint(self) -> Mapping[str, str]:
        """Return what identifies the list of samples."""
        keys = (" ".join(f"{m.sequence}/{m.frame}" for m in frame) for frame in self._frames)
        return {
            **{str(path): identify(path) for path in self._lists},
            f"{self.root}, {self.name}": identify_list(keys),
        }

    def _find_held_out(self, members: list[Member], folder: str | Path | None) -> HeldOutLabels | None:
        """Return the labels of evaluation images, if any are among the members."""
        count = sum(member.listed_in == "evaluation" for member in members)
        if not count:
            return None
        try:
            return HeldOutLabels.find(self.root, self._version, folder, need="any")
        except FileNotFoundError as error:
            if self._version == "v3" or folder is not None:
                raise
            _log.warning("%s: %d views are left out: %s", self.name, count, error)
            return None

    def _with_master(self, frames: list[tuple[Member, ...]]) -> list[tuple[Member, ...]]:
        """Return the frames that the first camera shows."""
        kept = [frame for frame in frames if frame[0].camera == VIEW_ORDER[0]]
        if len(kept) < len(frames):
            _log.warning(
                "%s: %d frames are left out, as they lack camera %d, which comes first",
                *(self.name, len(frames) - len(kept), VIEW_ORDER[0]),
            )
        return kept

    def _find_calibrations(self) -> dict[str, Calibration | None]:
        """Return those of the recordings with several cameras, by main sequence."""
        firsts = (frame[0] for frame in self._frames)
        mains = sorted({member.main for member in firsts if member.camera is not None})
        folders = [self.root / "calibration"]
        if self._version == "v2":
            folders += [self.root.parent / name / "calibration" for name in ("HO3D_v3", "HO-3D_v3")]
        found = {main: Calibration.find(folders, main) for main in mains}
        missing = [main for main, calibration in found.items() if calibration is None]
        if missing and self._version == "v3":
            raise FileNotFoundError(
                f"the calibration of {missing[0]} is missing: expected {folders[0] / missing[0]}. {ADVICE}"
            )
        if missing:
            _log.warning(
                "%s: the extrinsics of %s are made from the labels, as there is no calibration in %s",
                *(self.name, ", ".join(missing), " or ".join(str(folder) for folder in folders)),
            )
        return found

    def _read_label(self, member: Member, key: str) -> ViewLabel:
        path = self.root / member.listed_in / member.sequence / "meta" / f"{member.frame}.pkl"
        held_out = None
        if member.listed_in == "evaluation" and self._held_out is not None:
            held_out = self._held_out.read(member.sequence, member.place, member.row, key)
        return read_view(path, key, self._mano, held_out)

    def _extrinsics(
        self, members: tuple[Member, ...], joints_cam: Float[Array, "view 21 3"], key: str
    ) -> Float[Array, "view 4 4"]:
        digits = [member.camera for member in members if member.camera is not None]
        if self._split == "evaluation" or not digits:
            return np.eye(4)[None]
        first = members[0]
        calibration = self._calibrations[first.main]
        if calibration is None:
            return align_labels(joints_cam, self.root / first.listed_in / first.sequence, key)
        return calibration.extrinsics(digits, joints_cam, key)

    def _image_path(self, member: Member) -> Path:
        folder = self.root / member.listed_in / member.sequence / "rgb"
        paths = [folder / f"{member.frame}{suffix}" for suffix in _SUFFIXES[self._version]]
        return next((path for path in paths if path.is_file()), paths[0])


def _is_view_of(member: Member, mains: tuple[str, ...]) -> bool:
    return member.main in mains and member.camera is not None


def _stacked(values: list[Array | None]) -> Array | None:
    known = [value for value in values if value is not None]
    return np.stack(known).astype(np.float32) if len(known) == len(values) else None


def _boxes(labels: list[ViewLabel], keypoints_px: Float[Array, "view 21 2"]) -> Float[Array, "view 4"] | None:
    """Return the set's boxes where it has them, else those of the key points; None where it has none."""
    if all(label.box_index is None for label in labels):
        return None
    around = np.concatenate([keypoints_px.min(1), keypoints_px.max(1)], axis=-1)
    given = [
        own if label.box_index is None else span_pixels(label.box_index.reshape(2, 2)).reshape(4)
        for label, own in zip(labels, around, strict=True)
    ]
    return np.stack(given)
