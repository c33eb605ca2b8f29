"""Tiny raw data sets around one planted hand, written from the sets' descriptions; images are not drawn."""

import json
import pickle
from pathlib import Path

import numpy as np
import yaml

from poem_jax.geometry.transforms import axis_angle_from_rotation, rotation_from_axis_angle
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import OPENPOSE_FROM_MANO
from poem_jax.miniatures.mano_stand_in import stand_in_components
from tests.data.one_frame import one_frame

SERIALS = (
    *("836212060125", "839512060362", "840412060917", "841412060263"),
    *("932122060857", "932122060861", "932122061900", "932122062010"),
)
FLIP = np.diag([1.0, -1.0, -1.0])
IMAGE = b"\xff\xd8 a picture \xff\xd9"


def index_K(frame):
    K = frame.K.copy()
    K[:, :2, 2] -= 0.5
    return K


def wrist_offset(frame, joints):
    """What a MANO layer without centring must be moved by."""
    hand = default_hand()
    rest = hand.v_template + hand.shapedirs @ frame.shape[0]
    return joints[:, 0] - hand.J_regressor[0] @ rest


def write_image(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(IMAGE)


def write_yaml(path: Path, content: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content))


def write_pickle(path: Path, content: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content))


def write_dexycb(root: Path, *, subject=1, sequences=5, frames=1, side="right", absent=()):
    """One subject whose sequences all show one hand; `absent`: (camera, frame) pairs without it.

    Returns: the planted frame, in the order of the serials.
    """
    frame = one_frame(views=8, skew=0.0)
    calibration, K = root / "calibration", index_K(frame)
    poses = np.linalg.inv(frame.T_cam_from_world)[:, :3]
    stored = {serial: poses[i].ravel().tolist() for i, serial in enumerate(SERIALS)}
    write_yaml(calibration / "extrinsics_20200702_151821" / "extrinsics.yml", {"extrinsics": stored})
    for i, serial in enumerate(SERIALS):
        colour = {"fx": K[i, 0, 0], "fy": K[i, 1, 1], "ppx": K[i, 0, 2], "ppy": K[i, 1, 2]}
        content = {"color": {name: float(value) for name, value in colour.items()}}
        write_yaml(calibration / "intrinsics" / f"{serial}_640x480.yml", content)
    write_yaml(
        calibration / "mano_20200709_140042_subject-01" / "mano.yml", {"betas": frame.shape[0].tolist()}
    )
    components = stand_in_components()
    fingers = frame.pose_cam[:, 1:].reshape(-1, 45)
    coefficients = (fingers - components.mean) @ np.linalg.inv(components.components)
    pose_m = np.concatenate(
        [frame.pose_cam[:, 0], coefficients, wrist_offset(frame, frame.joints_cam)], axis=1
    ).astype(np.float32)
    for number in range(sequences):
        folder = root / f"20200709-subject-{subject:02d}" / f"20200709_14{number:04d}"
        meta = {
            "num_frames": frames,
            "extrinsics": "20200702_151821",
            "mano_sides": [side],
            "mano_calib": ["20200709_140042_subject-01"],
        }
        write_yaml(folder / "meta.yml", meta)
        for i, serial in enumerate(SERIALS):
            for number_of_frame in range(frames):
                joint_2d = frame.keypoints_px[i : i + 1].astype(np.float32) - 0.5
                if (i, number_of_frame) in absent:
                    joint_2d = np.full_like(joint_2d, -1)
                write_image(folder / serial / f"color_{number_of_frame:06d}.jpg")
                np.savez_compressed(
                    folder / serial / f"labels_{number_of_frame:06d}.npz",
                    seg=np.zeros((480, 640), np.uint8),
                    joint_3d=frame.joints_cam[i : i + 1].astype(np.float32),
                    joint_2d=joint_2d,
                    pose_m=pose_m[i : i + 1],
                )
    return frame


def write_ho3d(root: Path, *, orders=(1, 3, 2, 0, 4), authors=True, calibration=True, cameras=range(5)):
    """ABF1 (training) and SB1 (test; cameras 1 and 3 held out), one instant each.

    Args:
        orders: of `cam_orders.txt`; not its own inverse.
        authors: pair camera orders[i] with `trans_i`, else as the released POEM reads.
        calibration: write it.
        cameras: that are listed.

    Returns: the planted frame, in the order of the cameras 0 to 4.
    """
    frame = one_frame(views=5, skew=0.0)
    K, poses = index_K(frame), np.linalg.inv(frame.T_cam_from_world)
    file_of = [orders.index(d) if authors else orders[d] for d in range(5)]
    for main in ("ABF1", "SB1") if calibration else ():
        folder = root / "calibration" / main / "calibration"
        folder.mkdir(parents=True)
        (folder / "cam_orders.txt").write_text("".join(f"{order:.18e}\n" for order in orders))
        for d in range(5):
            np.savetxt(folder / f"trans_{file_of[d]}.txt", poses[d])
    to_mano = np.argsort(OPENPOSE_FROM_MANO)
    joints = frame.joints_cam @ FLIP
    # The root of OpenGL's frame: G exp(root) = exp(root of OpenCV's frame).
    lists = {"train": [], "evaluation": []}
    offset = wrist_offset(frame._replace(joints_cam=joints), joints)
    for d in cameras:
        pose = frame.pose_cam[d].copy()
        pose[0] = axis_angle_from_rotation(FLIP @ rotation_from_axis_angle(pose[0]))
        label = {
            "handJoints3D": joints[d][to_mano].astype(np.float32),
            "handPose": pose.ravel().astype(np.float32),
            "handTrans": offset[d].astype(np.float32),
            "handBeta": frame.shape[d].astype(np.float32),
            "camMat": K[d],
            "objName": "003_cracker_box",
        }
        held_out = {
            "handJoints3D": joints[d, 0].astype(np.float32),
            "camMat": K[d],
            "handBoundingBox": [100, 80, 200, 160],
        }
        for sequence, frame_id in ((f"ABF1{d}", "0007"), (f"SB1{d}", "0043")):
            where = "evaluation" if sequence in ("SB11", "SB13") else "train"
            lists[where].append(f"{sequence}/{frame_id}")
            write_pickle(
                root / where / sequence / "meta" / f"{frame_id}.pkl",
                held_out if where == "evaluation" else label,
            )
            write_image(root / where / sequence / "rgb" / f"{frame_id}.jpg")
    for name, lines in lists.items():
        (root / f"{name}.txt").write_text("\n".join(lines))
    return frame


def write_ho3d_archive(folder: Path, frame) -> None:
    """POEM's labels of the held-out views: OpenCV axes, OpenPose order, numbered from 0."""
    for d in (1, 3):
        label = {
            "target_joints_3d": frame.joints_cam[d],
            "target_verts_3d": frame.vertices_cam[d],
            "mano_pose": frame.pose_cam[d].ravel(),
            "mano_shape": frame.shape[d],
        }
        write_pickle(folder / f"SB1{d}" / "meta" / "0000.pkl", label)


def write_ho3d_official(folder: Path, frame) -> None:
    """The authors' labels: OpenGL axes, MANO's order, in the order of `evaluation.txt`."""
    folder.mkdir(parents=True, exist_ok=True)
    joints = frame.joints_cam[[1, 3]] @ FLIP
    joints = joints[:, np.argsort(OPENPOSE_FROM_MANO)]
    (folder / "evaluation_xyz.json").write_text(json.dumps(joints.tolist()))
    (folder / "evaluation_verts.json").write_text(json.dumps((frame.vertices_cam[[1, 3]] @ FLIP).tolist()))


def write_freihand(root: Path, *, unique=2, backgrounds=4):
    """Training lists of `unique` labels and four images for each; returns the planted frame."""
    frame = one_frame(views=unique, skew=0.0)
    for number in range(unique * backgrounds):
        write_image(root / "training" / "rgb" / f"{number:08d}.jpg")
    mean = stand_in_components().mean
    pose = np.concatenate([frame.pose_cam[:, 0], frame.pose_cam[:, 1:].reshape(-1, 45) - mean], 1)
    mano = np.concatenate([pose, frame.shape, np.zeros((unique, 3))], 1)
    rows = {"K": index_K(frame), "xyz": frame.joints_cam, "verts": frame.vertices_cam, "mano": mano[:, None]}
    for name, values in rows.items():
        (root / f"training_{name}.json").write_text(json.dumps(values.tolist()))
    return frame
