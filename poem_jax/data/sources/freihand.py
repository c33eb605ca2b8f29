"""FreiHAND v2 (Zimmermann et al., ICCV 2019): single images of right hands, 224 x 224.

Layout (github.com/lmb-freiburg/freihand):

    FreiHAND_v2/{training,evaluation}/rgb/%08d.jpg, training_{K,xyz,verts,mano}.json
    FreiHAND_v2_eval/evaluation_{K,xyz,verts,mano}.json     (the authors' FreiHAND_pub_v2_eval, which has
                                                             evaluation/ as well and can do alone)

Conventions of the set: metres in the camera's frame, which is the world; joints in OpenPose order; the 61
numbers of `mano` are the wrist's rotation, 45 finger numbers relative to MANO's mean pose, 10 of the shape,
and three of a translation in the image; pixels have their origin at a pixel's centre, so K gets + 0.5, and
key points are projections.

There are 32,560 unique training images, which the paper trains on, and 3,960 for the evaluation. The set has
each training image before four backgrounds, 130,240 in all: image i has the labels i mod 32,560, and the
first 32,560, taken before a green screen, come first.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from poem_jax.data.frames import MultiViewFrame, check_frame
from poem_jax.data.sources.annotation_cache import json_rows
from poem_jax.data.sources.hand_in_views import ManoFile, span_intrinsics
from poem_jax.data.sources.raw_sets import (
    check_choice,
    check_count,
    find_folder,
    identify,
    need_file,
    read_image,
)
from poem_jax.geometry.cameras import project_cam
from poem_jax.hand.topology import NUM_JOINTS, NUM_VERTICES

SPLITS = ("train", "test", "evaluation")
"""The last two are the same: the set's `evaluation`."""
BACKGROUNDS = 4
UNIQUE_IMAGES = 32_560
"""Training images in front of the green screen; their numbers start the next background's."""
EVALUATION_IMAGES = 3_960
SIZE = 224
ADVICE = (
    "Get FreiHAND_pub_v2.zip and FreiHAND_pub_v2_eval.zip from "
    "lmb.informatik.uni-freiburg.de/projects/freihand (for research only)"
)
_ROW_SHAPES = {"K": (3, 3), "xyz": (NUM_JOINTS, 3), "verts": (NUM_VERTICES, 3), "mano": (61,)}
_POSE_NUMBERS = 48
_EVALUATION_FOLDERS = ("FreiHAND_v2_eval", "FreiHAND_pub_v2_eval")


class FreiHAND:
    """One split of FreiHAND as frames of one view."""

    def __init__(
        self,
        root: str | Path,
        *,
        split: str = "train",
        backgrounds: int = 1,
        mano: str | Path | None = None,
        strict_counts: bool = False,
    ) -> None:
        """Open the lists of labels. The first time their text is read (a minute), then they are cached.

        Args:
            root: The folder `FreiHAND_v2`, or the one that holds it; for "test" `FreiHAND_v2_eval` will do.
            split: "train", or "test", also called "evaluation".
            backgrounds: How many of the four backgrounds a training image is taken with; 1 is the paper's.
            mano: The user's `MANO_RIGHT.pkl`: its mean pose is needed for poses. None: frames have no pose.
            strict_counts: Insist on the paper's number of images.

        Raises:
            FileNotFoundError: No such folder or list, or a background without its first image.
            ValueError: Another split or number of backgrounds, damaged lists, or lists of different lengths.
        """
        check_choice("split", split, SPLITS)
        if not 1 <= backgrounds <= BACKGROUNDS:
            raise ValueError(f"`backgrounds` must be 1 to {BACKGROUNDS}; got {backgrounds}")
        names = ("FreiHAND_v2", "FreiHAND_pub_v2", "FreiHAND")
        names += () if split == "train" else _EVALUATION_FOLDERS
        folder = "training" if split == "train" else "evaluation"
        self.root = find_folder(root, names, f"{folder}/rgb", advice=ADVICE)
        self.name = f"freihand {split}"
        self.max_views = 1
        self._images = self.root / folder / "rgb"
        self._mano = None if mano is None else ManoFile.open(mano)
        labels = self.root if split == "train" else _evaluation_labels(self.root)
        self._lists = {
            name: need_file(labels / f"{folder}_{name}.json", "a list of labels", advice=ADVICE)
            for name in _ROW_SHAPES
        }
        lengths = {name: len(json_rows(path, _ROW_SHAPES[name])) for name, path in self._lists.items()}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"the lists {labels}/{folder}_*.json must be equally long; got {lengths}")
        self._unique = lengths["K"]
        self._stride = UNIQUE_IMAGES if self._image(UNIQUE_IMAGES).is_file() else self._unique
        self._backgrounds = backgrounds if split == "train" else 1
        for k in range(self._backgrounds):
            need_file(self._image(k * self._stride), f"the first image of background {k + 1}", advice=ADVICE)
        check_count(
            self.name,
            len(self),
            self._backgrounds * UNIQUE_IMAGES if split == "train" else EVALUATION_IMAGES,
            strict=strict_counts,
            counted_by="the paper counts" if self._backgrounds == 1 else "the set's own count is",
        )

    def __len__(self) -> int:
        return self._unique * self._backgrounds

    def __getitem__(self, index: int) -> MultiViewFrame:
        """Read one image and its labels.

        Raises: CorruptSampleError: the image is missing, or its labels cannot be true.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has {len(self)} samples; got {index}")
        background, row = divmod(index, self._unique)
        path = self._image(background * self._stride + row)
        K, joints, vertices, mano = (
            np.array(json_rows(path, _ROW_SHAPES[name])[row]) for name, path in self._lists.items()
        )
        K = span_intrinsics(K)
        pose = None if self._mano is None else self._mano.add_mean(mano[:_POSE_NUMBERS])
        return check_frame(
            MultiViewFrame(
                key=f"{self._images.parent.name}/{path.stem}",
                images=(read_image(path, path.stem),),
                view_names=("0",),
                size_wh=np.array([[SIZE, SIZE]]),
                K=K[None],
                T_cam_from_world=np.eye(4)[None],
                joints_cam=joints[None],
                vertices_cam=vertices[None],
                keypoints_px=project_cam(K, joints.astype(np.float64))[None],
                pose_cam=None if pose is None else pose[None],
                shape=mano[None, _POSE_NUMBERS : _POSE_NUMBERS + 10],
            ),
            path,
        )

    def fingerprint(self) -> Mapping[str, str]:
        """Return what identifies the list of samples."""
        short = self._lists["K"]
        return {str(short): identify(short), f"{self.root}, {self.name}": f"{len(self)} samples"}

    def _image(self, number: int) -> Path:
        return self._images / f"{number:08d}.jpg"


def _evaluation_labels(root: Path) -> Path:
    """Return the folder of the evaluation lists: the archive of its own, beside the set or in it."""
    places = [root, *(place / name for name in _EVALUATION_FOLDERS for place in (root.parent, root))]
    return next((place for place in places if (place / "evaluation_xyz.json").is_file()), places[1])
