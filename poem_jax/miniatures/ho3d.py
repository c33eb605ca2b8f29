"""A tiny HO-3D, version 2 or 3: layout of `docs/datasets.md` and of github.com/shreyashampali/ho3d.

    HO3D_v3/{train, evaluation}/<SEQ>/{rgb/%04d.jpg, depth/%04d.png, meta/%04d.pkl}
    HO3D_v3/{train, evaluation}.txt, HO3D_v3/{evaluation_xyz, evaluation_verts}.json
    HO3D_v3/calibration/<SEQMAIN>/calibration/{trans_%d, cam_%d_intrinsics, cam_0_depth_scale, cam_orders}.txt
    HO3D_v3/manual_annotations/<SEQMAIN>_<frame>.npy
    HO3D_v3_manual_test_gt/<SEQ>/meta/%04d.pkl

Version 2 has PNG pictures, and neither calibration nor manual annotations. Labels have OpenGL axes and
MANO's joint order, poses are relative to the flat hand; in `evaluation` only the wrist and a box are given.
The manual archive has OpenCV axes and OpenPose's order, and numbers a sequence's frames from 0. Finger tips
are the second set of tip vertices. The last digit d of a sequence is its camera, whose pose camera -> common,
in OpenCV axes, is trans_{cam_orders[d]}.txt. Pixels have their origin at the centre of the first one.

Training: ABF1 (five cameras) and a sequence of one camera, which the multi-view set leaves out. Test: GPMF1,
whose pictures lie in `train`, and SB1, of which SB11 and SB13 lie in `evaluation`. The official evaluation
set also has AP1 and MPM1 (five cameras) and SM1, whose one camera has no digit. The archive labels SB1 alone.
"""

import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    invert_rigid,
    rotation_from_axis_angle,
)
from poem_jax.hand.topology import OPENPOSE_FROM_MANO, WRIST
from poem_jax.miniatures.files import save, save_json, save_npy
from poem_jax.miniatures.mano_stand_in import stand_in_hand
from poem_jax.miniatures.scene import (
    PlantedFrame,
    Rig,
    draw_rig,
    index_origin,
    jpeg,
    mano_translation,
    plant,
    png,
    take_views,
    with_mesh_tips,
)
from poem_jax.typing import Array, Float

SIZE_WH = (640, 480)
CAMERAS = ("0", "1", "2", "3", "4")
"""Digits at the end of a sequence's name."""
FIRST_CAMERA = 2
_OPENGL = np.diag([1.0, -1.0, -1.0])
_FRAME_NUMBERS = {"ABF1": 7, "GPMF1": 120, "SB1": 43, "SM2": 0, "AP1": 11, "MPM1": 58, "SM1": 5}
"""Of each sequence's first frame."""
_STEP = 3
_HELD_OUT = ("SB11", "SB13")
_EVALUATED = ("AP1", "MPM1")
"""Whose every camera is held out."""
_CAMERA_ORDERS = {
    "ABF1": (1, 2, 0, 4, 3),
    "GPMF1": (0, 1, 2, 3, 4),
    "SB1": (3, 0, 4, 2, 1),
    "AP1": (2, 0, 1, 4, 3),
    "MPM1": (4, 3, 1, 0, 2),
}
_BOX_MARGIN_PX = 10


def write(root: Path, *, frames: int = 2, seed: int = 0, version: str = "v3") -> list[PlantedFrame]:
    """Write a tiny HO-3D below `root` and return its multi-view frames: train, then test, then those of the
    official evaluation set that are not in test (AP1, MPM1, SM1).

    Args:
        root: the folder that will hold `HO3D_<version>` and, for v3, `HO3D_v3_manual_test_gt`.
        frames: of ABF1 and of SB1; the others have one.
        seed: of all chance.
        version: "v2" or "v3".
    """
    data = Path(root) / f"HO3D_{version}"
    listed: dict[str, list[tuple[str, PlantedFrame, int]]] = {"train": [], "evaluation": []}
    planted = []
    counts = {"ABF1": frames, "GPMF1": 1, "SB1": frames, **dict.fromkeys(_EVALUATED, 1)}
    for number, (main, count) in enumerate(counts.items()):
        rig = draw_rig((seed, 30, number), CAMERAS, SIZE_WH)
        shown = _plant(rig, main, count, (seed, 31, number))
        planted += [_as_listed(frame) for frame in shown.values()]
        for view, digit in enumerate(CAMERAS):
            split = "evaluation" if main in _EVALUATED or main + digit in _HELD_OUT else "train"
            listed[split] += [(f"{main}{digit}/{name}", frame, view) for name, frame in shown.items()]
        if version == "v3":
            _write_calibration(data / "calibration" / main / "calibration", rig, _CAMERA_ORDERS[main])
            _write_manual(root, data, main, shown)
    for number, (main, split) in enumerate({"SM2": "train", "SM1": "evaluation"}.items()):
        alone = draw_rig((seed, 32, number), (main,), SIZE_WH)
        for name, frame in _plant(alone, main, 1, (seed, 33, number)).items():
            listed[split].append((f"{main}/{name}", frame, 0))
            planted += [frame] if split == "evaluation" else []
    for split, lines in listed.items():
        save(data / f"{split}.txt", "".join(f"{line}\n" for line, _, _ in lines).encode())
        for line, frame, view in lines:
            _write_frame(data / split, line, frame, view, version)
    _write_unlabelled(data / "train" / "SM2", version)
    _write_evaluation(data, listed["evaluation"])
    return planted


def _plant(rig: Rig, main: str, count: int, seed: tuple[int, ...]) -> dict[str, PlantedFrame]:
    """Return the frames by their file's name; one shape for all."""
    shape = np.random.default_rng(seed).standard_normal(10)
    names = [f"{_FRAME_NUMBERS[main] + _STEP * n:04d}" for n in range(count)]
    return {
        name: with_mesh_tips(plant((*seed, n), rig, stand_in_hand(), key_hint=f"{main}/{name}", shape=shape))
        for n, name in enumerate(names)
    }


def _as_listed(frame: PlantedFrame) -> PlantedFrame:
    others = [view for view in range(len(CAMERAS)) if view != FIRST_CAMERA]
    return take_views(frame, [FIRST_CAMERA, *others])


def _write_frame(folder: Path, line: str, frame: PlantedFrame, view: int, version: str) -> None:
    sequence, name = line.split("/")
    held_out = folder.name == "evaluation"
    image = frame.images[view]
    picture = jpeg(image) if version == "v3" else png(image)
    save(folder / sequence / "rgb" / f"{name}{_suffix(version)}", picture)
    save(folder / sequence / "depth" / f"{name}.png", _depth())
    meta = _held_out_label(frame, view) if held_out else _label(frame, view)
    save(folder / sequence / "meta" / f"{name}.pkl", pickle.dumps(meta, protocol=2))


def _suffix(version: str) -> str:
    return ".jpg" if version == "v3" else ".png"


def _depth() -> bytes:
    """Return 0.8 m everywhere: the low byte in red, the high one in green."""
    depth = np.zeros((*SIZE_WH[::-1], 3), np.uint8)
    depth[..., 2], depth[..., 1] = 6401 % 256, 6401 // 256
    return cv2.imencode(".png", depth)[1].tobytes()


def _object(frame: PlantedFrame, view: int) -> dict[str, Any]:
    """Return the thing in the hand: it lies as the camera's world does, in the middle of the joints."""
    R = frame.T_cam_from_world[view, :3, :3]
    corners = 0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    place = frame.joints_cam[view].mean(0)
    return {
        "objRot": axis_angle_from_rotation(_OPENGL @ R)[:, None],
        "objTrans": _OPENGL @ place,
        "objCorners3D": (corners @ R.T + place) @ _OPENGL,
        "objCorners3DRest": corners,
        "objName": "021_bleach_cleanser",
        "objLabel": 12,
    }


def _label(frame: PlantedFrame, view: int) -> dict[str, Any]:
    R_cam_from_hand = rotation_from_axis_angle(frame.pose_cam[view, WRIST])
    pose = frame.pose_cam[view].copy()
    pose[WRIST] = axis_angle_from_rotation(_OPENGL @ R_cam_from_hand)
    rest = frame.joints_cam[view, WRIST] - mano_translation(stand_in_hand(), frame)[view]
    return {
        **_object(frame, view),
        "camMat": index_origin(frame.K[view]),
        "handJoints3D": _mano_order(frame.joints_cam[view] @ _OPENGL).astype(np.float32),
        "handPose": pose.reshape(-1).astype(np.float32),
        "handTrans": (_OPENGL @ frame.joints_cam[view, WRIST] - rest).astype(np.float32),
        "handBeta": frame.shape.astype(np.float32),
        "handVertContact": np.zeros(778, bool),
        "handVertDist": np.full(778, 0.05, np.float32),
        "handVertIntersec": np.zeros(778, bool),
        "handVertObjSurfProj": (frame.vertices_cam[view] @ _OPENGL).astype(np.float32),
    }


def _held_out_label(frame: PlantedFrame, view: int) -> dict[str, Any]:
    px = frame.keypoints_px[view] - 0.5
    box = [*(px.min(0) - _BOX_MARGIN_PX), *(px.max(0) + _BOX_MARGIN_PX)]
    return {
        **_object(frame, view),
        "camMat": index_origin(frame.K[view]),
        "handJoints3D": (_OPENGL @ frame.joints_cam[view, WRIST]).astype(np.float32),
        "handBoundingBox": [int(edge) for edge in box],
    }


def _mano_order(joints: Float[Array, "21 3"]) -> Float[Array, "21 3"]:
    """Return 16 skeleton joints and 5 tips from joints in OpenPose's order."""
    ordered = np.empty_like(joints)
    ordered[list(OPENPOSE_FROM_MANO)] = joints
    return ordered


def _write_unlabelled(folder: Path, version: str) -> None:
    """Write a frame that the annotation skipped: its files exist, its labels are None, no list has it."""
    names = ("handJoints3D", "handPose", "handTrans", "handBeta", "objRot", "objTrans", "objCorners3D")
    meta = {**dict.fromkeys(names), "camMat": np.eye(3), "objName": "021_bleach_cleanser", "objLabel": 12}
    save(folder / "meta" / "0001.pkl", pickle.dumps(meta, protocol=2))
    grey = np.full((*SIZE_WH[::-1], 3), 127, np.uint8)
    save(folder / "rgb" / f"0001{_suffix(version)}", jpeg(grey) if version == "v3" else png(grey))
    save(folder / "depth" / "0001.png", _depth())


def _write_calibration(folder: Path, rig: Rig, orders: tuple[int, ...]) -> None:
    T_common_from_cam, K = invert_rigid(rig.T_cam_from_world), index_origin(rig.K)
    for digit, file_number in enumerate(orders):
        rows = "".join(" ".join(f"{value:.18e}" for value in row) + "\n" for row in T_common_from_cam[digit])
        save(folder / f"trans_{file_number}.txt", rows.encode())
        fx, fy, cx, cy = K[digit][[0, 1, 0, 1], [0, 1, 2, 2]]
        text = f"Intrinsics: width: 640, height: 480, ppx: {cx}, ppy: {cy}, fx: {fx}, fy: {fy}\n"
        save(folder / f"cam_{file_number}_intrinsics.txt", text.encode())
    save(folder / "cam_0_depth_scale.txt", b"1.249866472790e-04\n")
    save(folder / "cam_orders.txt", "".join(f"{order:.18e}\n" for order in map(float, orders)).encode())


def _write_manual(root: Path, data: Path, main: str, shown: dict[str, PlantedFrame]) -> None:
    """Write the truth of what is held out, and the finger tips that people marked."""
    for number, (name, frame) in enumerate(shown.items()):
        marked = _mano_order(frame.joints_cam[1] @ _OPENGL)[[20, 19, 18, 17, 16]]
        save_npy(data / "manual_annotations" / f"{main}_{name}.npy", marked)
        for view, digit in enumerate(CAMERAS):
            if main + digit not in _HELD_OUT:
                continue
            label = {
                "target_joints_3d": frame.joints_cam[view].astype(np.float32),
                "target_verts_3d": frame.vertices_cam[view].astype(np.float32),
                "mano_pose": frame.pose_cam[view].reshape(-1).astype(np.float32),
                "mano_shape": frame.shape.astype(np.float32),
            }
            folder = Path(root) / "HO3D_v3_manual_test_gt" / f"{main}{digit}" / "meta"
            save(folder / f"{number:04d}.pkl", pickle.dumps(label, protocol=4))


def _write_evaluation(data: Path, lines: list[tuple[str, PlantedFrame, int]]) -> None:
    """Write the challenge's truth, an entry a line of evaluation.txt, with the labels' axes and order."""
    joints = [_mano_order(frame.joints_cam[view] @ _OPENGL).tolist() for _, frame, view in lines]
    vertices = [(frame.vertices_cam[view] @ _OPENGL).tolist() for _, frame, view in lines]
    save_json(data / "evaluation_xyz.json", joints)
    save_json(data / "evaluation_verts.json", vertices)
