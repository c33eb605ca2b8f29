"""Tiny copies of the six sets of WebDataset archives that POEM-v2 was trained on.

A sample is one multi-view frame: members `<key>.image_<i>.jpg` (PNG for OakInk) and `<key>.label.pyd`, a
pickled dictionary in which every value is a list over the cameras. What the sets store differs:

    cam_extr   DexYCB and HO3D: camera -> world. InterHand2.6M, ARCTIC and OakInk: world -> camera. FreiHAND
               has one camera, which is the world.
    mano_pose  DexYCB, HO3D, FreiHAND: fingers with MANO's mean pose in them. ARCTIC, InterHand2.6M: less the
               mean pose. OakInk: absent. Axis-angle, the wrist turned into the camera.
    bbox       from the key points; in HO3D's test set, for two cameras, from a box of its own.

`request_flip` marks a left hand: labels are those of its mirror image about u = cx, pictures are not. Pixels
have their origin at the centre of the first one. `bbox_scale` is twice the box's side.
"""

import io
import pickle
import tarfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.miniatures import arctic, interhand, oakink
from poem_jax.miniatures.files import save
from poem_jax.miniatures.labels import moved_fingers, with_smplx_tips
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand
from poem_jax.miniatures.scene import (
    PlantedFrame,
    draw_rig,
    index_origin,
    jpeg,
    mirrored,
    plant,
    png,
)
from poem_jax.typing import Array, Float

_DEXYCB_CAMERAS = (
    *("840412060917", "836212060125", "839512060362", "841412060263"),
    *("932122060857", "932122060861", "932122061900", "932122062010"),
)
"""The master first."""
_HO3D_CAMERAS = ("2", "0", "1", "3", "4")
_HANDS_MEAN = stand_in_components().mean.astype(np.float64)


class _Kind(NamedTuple):
    """How one set was packed."""

    train: str
    """Of the archives, below the root and without number and suffix."""
    evaluation: str
    views: tuple[str, ...]
    sizes_wh: Sequence[tuple[int, int]]
    world_to_camera: bool = False
    less_mean: bool = False
    has_mano: bool = True
    flips: bool = False
    """Its second sample is a left hand."""
    suffix: str = "jpg"


KINDS = {
    "dexycb": _Kind(
        "DexYCB_mv/DexYCB_mv_train", "DexYCB_mv/DexYCB_mv_test", _DEXYCB_CAMERAS, [(640, 480)] * 8
    ),
    "ho3d": _Kind("HO3D_mv/HO3D_mv_train", "HO3D_mv_test/HO3D_mv_test", _HO3D_CAMERAS, [(640, 480)] * 5),
    "oakink": _Kind(
        "Oakink_mv/Oakink_mv_train+val",
        "Oakink_mv/Oakink_mv_test",
        oakink.VIEWS,
        [oakink.SIZE_WH] * 4,
        world_to_camera=True,
        has_mano=False,
        suffix="png",
    ),
    "arctic": _Kind(
        "Arctic_mv/Arctic_mv_train_p1",
        "Arctic_mv/Arctic_mv_val_p1",
        arctic.VIEWS,
        [arctic.SIZE_WH] * 8,
        world_to_camera=True,
        less_mean=True,
        flips=True,
    ),
    "interhand": _Kind(
        "Interhand_mv/Interhand_mv_train",
        "Interhand_mv/Interhand_mv_val",
        interhand.CAMERAS[:8],
        [interhand.SIZES_WH[i % 3 == 2] for i in range(8)],
        world_to_camera=True,
        less_mean=True,
        flips=True,
    ),
    "freihand": _Kind("Freihand_mv/Freihand_mv_train", "Freihand_mv/Freihand_mv_test", ("0",), [(224, 224)]),
}
"""By the name under which a miniature is asked for, less `tars-`."""


def write(name: str, root: Path, *, samples: int = 2, seed: int = 0) -> list[PlantedFrame]:
    """Write archives of one set below `root` and return what they show.

    Args:
        name: one of `KINDS`.
        root: the folder that the authors call `dataset_tars`.
        samples: in train, one in each archive; the archive of the evaluation has one.
        seed: of all chance.
    """
    kind = KINDS[name]
    planted: list[PlantedFrame] = []
    for number in range(samples + 1):
        evaluates = number == samples
        key = f"{number:09d}"
        frame = _plant(name, (seed, 9, number), key, left=kind.flips and number == 1)
        members = {f"{key}.image_{i}.{kind.suffix}": _encode(kind, x) for i, x in enumerate(frame.images)}
        label = _label(name, frame, number, evaluates)
        if kind.flips:
            label["request_flip"] = number == 1
        members[f"{key}.label.pyd"] = pickle.dumps(label)
        stem, shard = (kind.evaluation, 0) if evaluates else (kind.train, number)
        save(Path(root) / f"{stem}-{shard:06d}.tar", archive(members))
        planted.append(frame)
    return planted


def archive(members: dict[str, bytes]) -> bytes:
    """Return a tar of files, as WebDataset's writer lays them out."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as tar:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size, info.mode, info.uname, info.gname = len(data), 0o444, "bigdata", "bigdata"
            tar.addfile(info, io.BytesIO(data))
    return stream.getvalue()


def members_of(path: Path) -> dict[str, bytes]:
    """Return the files of an archive, by name."""
    with tarfile.open(path) as tar:
        return {info.name: _content(tar, info) for info in tar.getmembers()}


def _content(tar: tarfile.TarFile, info: tarfile.TarInfo) -> bytes:
    stream = tar.extractfile(info)
    if stream is None:
        raise ValueError(f"{info.name} must be a plain file")
    return stream.read()


def _encode(kind: _Kind, image: Array) -> bytes:
    return png(image) if kind.suffix == "png" else jpeg(image, 90)


def _plant(name: str, seed: tuple[int, ...], key: str, *, left: bool) -> PlantedFrame:
    """Plant a sample's frame with the joints that its set has."""
    kind, side = KINDS[name], "left" if left else "right"
    if name == "arctic":
        frame = arctic.plant_large(seed, arctic.large_rig(seed), key, side=side)
    else:
        frame = plant(seed, draw_rig(seed, kind.views, kind.sizes_wh), stand_in_hand(side), key_hint=key)
    frame = mirrored(frame) if left else frame
    if name == "freihand":
        frame = frame._replace(T_cam_from_world=np.eye(4)[None])
    finish: dict[str, Callable[[PlantedFrame], PlantedFrame]] = {
        "arctic": with_smplx_tips,
        "interhand": lambda of: moved_fingers(of, seed[-1]),
    }
    return finish.get(name, lambda of: of)(frame)


def _label(name: str, frame: PlantedFrame, number: int, evaluates: bool) -> dict[str, Any]:
    """Return what `label.pyd` holds, most of it float32 as the readers had it."""
    kind, views = KINDS[name], range(len(frame.view_names))
    K = index_origin(frame.K)
    joints_2d, verts_2d = (project_cam(K, of) for of in (frame.joints_cam, frame.vertices_cam))
    T = frame.T_cam_from_world if kind.world_to_camera else invert_rigid(frame.T_cam_from_world)
    boxes = [_box(joints_2d[i]) for i in views]
    if name == "ho3d" and evaluates:
        boxes[1:3] = [_box(verts_2d[i] + 3.0) for i in (1, 2)]
    visible = ((joints_2d >= 0) & (joints_2d < frame.size_wh[:, None])).all(-1)
    label: dict[str, Any] = {
        "idx": [8 * number + i for i in views],
        "sample_idx": [8 * number + i for i in views],
        "cam_serial": list(frame.view_names),
        "cam_extr": _float32(T),
        "cam_intr": _float32(K),
        "cam_center": _float32(K[:, :2, 2]),
        "raw_size": [np.array(size) for size in frame.size_wh],
        "bbox_center": [np.array(center, np.float32) for center, _ in boxes],
        "bbox_scale": [np.float32(2 * side) for _, side in boxes],
        "joints_2d": _float32(joints_2d),
        "joints_3d": _float32(frame.joints_cam),
        "joints_vis": _float32(visible.astype(np.float32)),
        "joints_uvd": _float32(np.concatenate([joints_2d, frame.joints_cam[..., 2:]], axis=-1)),
        "verts_3d": _float32(frame.vertices_cam),
        "verts_uvd": _float32(np.concatenate([verts_2d, frame.vertices_cam[..., 2:]], axis=-1)),
        "image_path": [f"data/{kind.train}/{view}/{number:06d}.{kind.suffix}" for view in frame.view_names],
    }
    if kind.has_mano:
        mean = _HANDS_MEAN.reshape(15, 3) if kind.less_mean else 0
        stored = np.concatenate([frame.pose_cam[:, :1], frame.pose_cam[:, 1:] - mean], axis=1)
        label["mano_pose"] = _float32(stored.reshape(-1, *((48,) if kind.less_mean else (16, 3))))
        label["mano_shape"] = [frame.shape.astype(np.float32) for _ in views]
    return label


def _float32(values: Float[Array, "view ..."]) -> list[Float[Array, "..."]]:
    return list(np.asarray(values, np.float32))


def _box(points_px: Float[Array, "point 2"]) -> tuple[tuple[int, int], float]:
    """Return centre (cut to whole pixels) and side of the square around points, in pixels as stored."""
    low, high = points_px.min(0), points_px.max(0)
    center = (low + high) / 2
    return (int(center[0]), int(center[1])), float((high - low).max())
