"""The label of a released multi-view sample (`label.pyd`), and our frame: both ways, for all six data sets.

A label is a pickled dictionary whose values are lists with one entry a camera (`request_flip`: one for the
sample). What its numbers mean depends on the data set; `CONVENTIONS` says it, and nothing else knows it:

- `cam_extr` maps camera to world (DexYCB, HO-3D) or world to camera (OakInk, ARCTIC, InterHand2.6M); FreiHAND
  has one camera, which is the world.
- `mano_pose` is zero for a flat hand (DexYCB, HO-3D, FreiHAND: their readers add MANO's mean pose, or the
  data set has none), or relative to MANO's mean pose (ARCTIC, InterHand2.6M: their readers give the stored
  numbers to a layer with `flat_hand_mean` False). OakInk's released tars lack it. Zeros throughout stand
  for a pose that is not known.
- Pixels have their origin at the *centre* of the first pixel, as the tools with which these sets were
  calibrated: 0.5 is added to cx, cy, `joints_2d` and `bbox_center`.
- `bbox_scale` is twice the side of the hand's box already, the recipes' ratio of 2.
- `request_flip`: the hand was a left one. Labels and extrinsics are those of the mirrored, right hand; the
  image is as the camera took it. The release mirrors it by u' = 2 cx - u between centres of pixels, which is
  the same map, about the same line, where the image spans [0, W].
"""

import enum
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.data.crops import whole_pixels
from poem_jax.data.frames import EncodedImage, MultiViewFrame, check_frame
from poem_jax.data.label_fields import LabelFields
from poem_jax.data.sources.hand_in_views import ManoFile, span_intrinsics, span_pixels
from poem_jax.data.transforms import box_from_center
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES, NUM_SKELETON_JOINTS, NUM_VERTICES
from poem_jax.typing import Array, Float

BOX_RATIO = 2.0
"""In `bbox_scale`, over the side of the hand's box."""
_POSE_NUMBERS = 3 * NUM_SKELETON_JOINTS
_SAME_BOX_PX = 1.5
"""Two boxes are the same if centres and sides differ by less: centres are cut to whole pixels, those of
mirrored hands before the mirror."""


class Extrinsics(enum.Enum):
    """What `cam_extr` maps."""

    CAMERA_TO_WORLD = enum.auto()
    WORLD_TO_CAMERA = enum.auto()
    NONE = enum.auto()
    """One camera, which is the world; what is stored does not count."""


class TarConvention(NamedTuple):
    """What the labels of one data set mean."""

    name: str
    """First part of the tars' names."""
    extrinsics: Extrinsics
    pose_lacks_mean: bool = False
    """True: MANO's mean pose must be added, which needs the user's MANO file."""


CONVENTIONS = (
    TarConvention("DexYCB", Extrinsics.CAMERA_TO_WORLD),
    TarConvention("HO3D", Extrinsics.CAMERA_TO_WORLD),
    TarConvention("Oakink", Extrinsics.WORLD_TO_CAMERA),
    TarConvention("Arctic", Extrinsics.WORLD_TO_CAMERA, pose_lacks_mean=True),
    TarConvention("Interhand", Extrinsics.WORLD_TO_CAMERA, pose_lacks_mean=True),
    TarConvention("Freihand", Extrinsics.NONE),
)


def convention_of(shard_name: str) -> TarConvention:
    """Return the convention of a tar by its file name, whose part before the first `_` is the data set's.

    Raises:
        ValueError: no data set of that name.
    """
    first = shard_name.partition("_")[0]
    for convention in CONVENTIONS:
        if convention.name == first:
            return convention
    names = ", ".join(f"{convention.name}_mv_..." for convention in CONVENTIONS)
    raise ValueError(f"a shard must be named {names}, which says what its labels mean; got {shard_name}")


def frame_from_label(
    label: Any,
    images: Sequence[EncodedImage],
    convention: TarConvention,
    *,
    path: str | Path,
    key: str,
    mano: ManoFile | None = None,
) -> MultiViewFrame:
    """Return a frame from an unpickled label.

    Args:
        label: What `loads_arrays_pickle` gave.
        images: Of all cameras in the label's order.
        convention: Of the data set.
        path: The shard, for messages.
        key: Of the frame.
        mano: The user's MANO file, where `convention.pose_lacks_mean`; without it such poses are left out.

    Raises:
        CorruptSampleError: A field is missing, of a wrong shape or not finite, or the frame cannot be true.
    """
    read = LabelFields(label, len(images), path, key)
    K = span_intrinsics(read.array("cam_intr", (3, 3)))
    keypoints = span_pixels(read.array("joints_2d", (NUM_JOINTS, 2)))
    frame = MultiViewFrame(
        key=key,
        images=tuple(images),
        view_names=read.names("cam_serial"),
        size_wh=read.array("raw_size", (2,)).astype(np.int64),
        K=K.astype(np.float32),
        T_cam_from_world=_extrinsics(read, convention),
        joints_cam=read.array("joints_3d", (NUM_JOINTS, 3)).astype(np.float32),
        vertices_cam=read.array("verts_3d", (NUM_VERTICES, 3)).astype(np.float32),
        keypoints_px=keypoints.astype(np.float32),
        box_px=_own_boxes(read, keypoints),
        mirror_px=K[:, 0, 2].astype(np.float32) if read.flag("request_flip") else None,
    )
    return check_frame(_with_pose(frame, read, convention, mano), path)


def label_from_frame(
    frame: MultiViewFrame, convention: TarConvention, *, index: int, mano: ManoFile | None = None
) -> dict[str, Any]:
    """Invert `frame_from_label`: return a label of plain lists and arrays in the data set's own convention.

    Args:
        frame: Of that data set.
        convention: Of the data set.
        index: Of the sample in its source; kept as `idx`.
        mano: As in `frame_from_label`.

    Raises:
        ValueError: The frame has what a released label cannot say: a lens, or a mirror elsewhere than at cx.
    """
    if frame.dist is not None:
        raise ValueError(f"sample {frame.key} has a lens, which released tars have no field for")
    if frame.mirror_px is not None and np.abs(frame.mirror_px - frame.K[:, 0, 2]).max() > 1e-3:
        raise ValueError(f"sample {frame.key} is mirrored about another line than cx, as released tars are")
    views = range(len(frame.images))
    K = np.array(frame.K, np.float64)
    K[:, :2, 2] -= 0.5
    keypoints = np.asarray(frame.keypoints_px, np.float64) - 0.5
    centers, sides = _boxes_to_store(frame, keypoints)
    inside = ((keypoints >= 0) & (keypoints < frame.size_wh[:, None])).all(-1)
    extrinsics = np.asarray(frame.T_cam_from_world, np.float64)
    if convention.extrinsics is Extrinsics.CAMERA_TO_WORLD:
        extrinsics = invert_rigid(extrinsics)
    label: dict[str, Any] = {
        "cam_extr": extrinsics.astype(np.float32),
        "cam_intr": K.astype(np.float32),
        "cam_center": K[:, :2, 2].astype(np.float32),
        "raw_size": np.asarray(frame.size_wh, np.int64),
        "joints_3d": frame.joints_cam.astype(np.float32),
        "verts_3d": frame.vertices_cam.astype(np.float32),
        "joints_2d": keypoints.astype(np.float32),
        "joints_vis": inside.astype(np.float32),
        "bbox_center": centers.astype(np.float32),
        "bbox_scale": (BOX_RATIO * sides).astype(np.float32),
        **_pose_to_store(frame, convention, mano),
    }
    label = {name: [np.array(array[view]) for view in views] for name, array in label.items()}
    label |= {
        "bbox_scale": [float(scale) for scale in label["bbox_scale"]],
        "cam_serial": list(frame.view_names),
        "image_path": [image.name for image in frame.images],
        "idx": [index for _ in views],
        "request_flip": frame.mirror_px is not None,
    }
    return label


def _extrinsics(read: LabelFields, convention: TarConvention) -> Float[Array, "view 4 4"]:
    if convention.extrinsics is Extrinsics.NONE:
        return np.tile(np.eye(4, dtype=np.float32), (len(read.names("cam_serial")), 1, 1))
    T = read.array("cam_extr", (4, 4))
    if convention.extrinsics is Extrinsics.CAMERA_TO_WORLD:
        # What is no rotation, and what the last row holds, stays to be seen by `check_frame`.
        last = T[:, 3:].copy()
        T = np.concatenate([invert_rigid(T)[:, :3], last], axis=1)
    return T.astype(np.float32)


def _own_boxes(read: LabelFields, keypoints_px: Float[Array, "view 21 2"]) -> Float[Array, "view 4"] | None:
    """Return the label's boxes where they are not those of the key points (test images of HO-3D)."""
    center, scale = read.array("bbox_center", (2,)), read.array("bbox_scale", ())
    if (scale <= 0).any():
        raise read.error(f"`bbox_scale` must be positive; got {scale.tolist()}")
    side = scale / BOX_RATIO
    low, high = keypoints_px.min(1), keypoints_px.max(1)
    of_points = span_pixels(whole_pixels((low + high) / 2 - 0.5))
    moved = np.abs(center + 0.5 - of_points).max(-1)
    if (moved <= _SAME_BOX_PX).all() and (np.abs(side - (high - low).max(-1)) <= _SAME_BOX_PX).all():
        return None
    return box_from_center(span_pixels(center), side)


def _boxes_to_store(frame: MultiViewFrame, keypoints_index: Array) -> tuple[Array, Array]:
    """Return centres, whole pixels between centres of pixels, and sides; DATASETS' rule for boxes."""
    if frame.box_px is None:
        low, high = keypoints_index.min(1), keypoints_index.max(1)
    else:
        low, high = frame.box_px[:, :2] - 0.5, frame.box_px[:, 2:] - 0.5
    return whole_pixels((low + high) / 2), (high - low).max(-1)


def _with_pose(
    frame: MultiViewFrame, read: LabelFields, convention: TarConvention, mano: ManoFile | None
) -> MultiViewFrame:
    if not read.has("mano_pose") or (convention.pose_lacks_mean and mano is None):
        return frame
    pose = read.array("mano_pose", (_POSE_NUMBERS,), cut=True)
    shape = read.array("mano_shape", (NUM_SHAPES,)).astype(np.float32)
    if not pose.any(-1).all():
        return frame
    if convention.pose_lacks_mean and mano is not None:
        return frame._replace(pose_cam=mano.add_mean(pose), shape=shape)
    whole = pose.reshape(-1, NUM_SKELETON_JOINTS, 3).astype(np.float32)
    return frame._replace(pose_cam=whole, shape=shape)


def _pose_to_store(
    frame: MultiViewFrame, convention: TarConvention, mano: ManoFile | None
) -> dict[str, Array]:
    if frame.pose_cam is None or frame.shape is None or (convention.pose_lacks_mean and mano is None):
        return {}
    pose = frame.pose_cam.reshape(-1, _POSE_NUMBERS).astype(np.float32)
    if convention.pose_lacks_mean and mano is not None:
        pose = pose - np.concatenate([np.zeros(3, np.float32), mano.components.mean])
    return {"mano_pose": pose, "mano_shape": frame.shape.astype(np.float32)}
