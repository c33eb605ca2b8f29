"""A tiny DexYCB: layout of dex-ycb.github.io and its toolkit (github.com/NVlabs/dex-ycb-toolkit).

    <date-subject>/<date_time>/{meta.yml, pose.npz}
    <date-subject>/<date_time>/<serial>/{color_%06d.jpg, aligned_depth_to_color_%06d.png, labels_%06d.npz}
    calibration/{extrinsics_<id>/extrinsics.yml, intrinsics/<serial>_640x480.yml, mano_<id>/mano.yml}
    models/<object>/textured_simple.obj

Extrinsics are camera -> calibration master; `pose_m` is a wrist's axis-angle, 45 principal components and a
translation, in the camera's frame; joints come in OpenPose's order; -1 and zeros mark an absent hand. Pixels
have their origin at the centre of the first one.

Two of the ten subjects are here, with five of their hundred sequences each, so that the fifth is what S0
holds out: for validation of the first subject, for the test of the third. All others are of left hands, and
but for one without frames, except the very first, which trains. That one also has a frame without a hand, and
one where a camera lacks it.
"""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.hand.topology import WRIST
from poem_jax.miniatures.files import CUBE_OBJ, save
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand
from poem_jax.miniatures.scene import (
    PlantedFrame,
    Rig,
    anchored,
    draw_rig,
    index_origin,
    jpeg,
    mano_translation,
    plant,
    take_views,
)
from poem_jax.typing import Array, Float

SERIALS = (
    "836212060125",
    "839512060362",
    "840412060917",
    "841412060263",
    "932122060857",
    "932122060861",
    "932122061900",
    "932122062010",
)
MASTER = "840412060917"
SIZE_WH = (640, 480)
_SEQUENCES = {
    "20200709-subject-01": (
        "20200709_141754",
        "20200709_141841",
        "20200709_141931",
        "20200709_142022",
        "20200709_142123",
    ),
    "20200820-subject-03": (
        "20200820_135508",
        "20200820_135545",
        "20200820_135612",
        "20200820_135641",
        "20200820_135810",
    ),
}
_EXTRINSICS = {"20200709-subject-01": "20200702_151821", "20200820-subject-03": "20200813_143449"}
_OBJECTS = {2: "003_cracker_box", 10: "011_banana"}
_BLIND = "932122061900"
"""The camera that lacks the hand in the second frame."""
_ABSENT = -1.0


def write(root: Path, *, frames: int = 2, seed: int = 0) -> list[PlantedFrame]:
    """Write a tiny DexYCB into `root` and return what S0 keeps of it: train, val, test.

    Args:
        root: the folder that will hold the subjects, `calibration` and `models`.
        frames: of the training sequence; the other two have one each.
        seed: of all chance.
    """
    root = Path(root)
    first = draw_rig((seed, 10), SERIALS, SIZE_WH)
    _write_intrinsics(root / "calibration" / "intrinsics", first)
    for name in _OBJECTS.values():
        save(root / "models" / name / "textured_simple.obj", CUBE_OBJ)
    planted = []
    for number, subject in enumerate(_SEQUENCES):
        rig = first if number == 0 else draw_rig((seed, 10, number), SERIALS, SIZE_WH)._replace(K=first.K)
        _write_extrinsics(root / "calibration" / f"extrinsics_{_EXTRINSICS[subject]}", rig)
        planted += _write_subject(root, subject, rig, frames, (seed, 11, number))
    return planted


def _write_subject(
    root: Path, subject: str, rig: Rig, frames: int, seed: tuple[int, ...]
) -> list[PlantedFrame]:
    """Write five sequences and the hand's shape; return the frames of the right hands."""
    shape = np.random.default_rng(seed).standard_normal(10).astype(np.float32).astype(np.float64)
    for side in ("right", "left"):
        folder = root / "calibration" / f"mano_{subject}_{side}"
        save(folder / "mano.yml", _yaml({"betas": shape.tolist()}).encode())
    kept = []
    sequences = _SEQUENCES[subject]
    has_training = subject == next(iter(_SEQUENCES))
    for index, sequence in enumerate(sequences):
        folder = root / subject / sequence
        trains = index == 0 and has_training
        if index < 4 and not trains:
            shown = [_plant((*seed, 9), rig, "", shape, "left")] if index == 1 and has_training else []
            _write_sequence(folder, subject, "left", [_labels(frame, "left") for frame in shown], shown)
            continue
        shown = [
            _plant((*seed, index, n), rig, f"{subject}/{sequence}/{n:06d}", shape, "right")
            for n in range(frames if trains else 1)
        ]
        labels = [_labels(frame, "right") for frame in shown]
        visible = [list(range(len(SERIALS)))] * len(shown)
        if trains:
            labels.append([_without_hand(one) for one in labels[0]])
            if frames > 1:
                blind = SERIALS.index(_BLIND)
                labels[1][blind] = _without_hand(labels[1][blind])
                visible[1] = [view for view in visible[1] if view != blind]
        _write_sequence(folder, subject, "right", labels, [*shown, *shown[:1]][: len(labels)])
        kept += [_as_listed(frame, views) for frame, views in zip(shown, visible, strict=True)]
    return kept


def _plant(seed: tuple[int, ...], rig: Rig, hint: str, shape: Float[Array, "10"], side: str) -> PlantedFrame:
    return plant(seed, rig, stand_in_hand(side), key_hint=hint, shape=shape)


def _as_listed(frame: PlantedFrame, views: list[int]) -> PlantedFrame:
    """Return the frame in the world of the file, the master camera first."""
    master = SERIALS.index(MASTER)
    return take_views(anchored(frame, master), [master, *(view for view in views if view != master)])


def _labels(frame: PlantedFrame, side: str) -> list[dict[str, np.ndarray]]:
    """Return the label file of every camera."""
    components = stand_in_components(side)
    translation = mano_translation(stand_in_hand(side), frame)
    labels = []
    for view in range(len(frame.view_names)):
        fingers = frame.pose_cam[view, 1:].reshape(-1)
        coefficients = components.components.astype(np.float64) @ (fingers - components.mean)
        pose = np.concatenate([frame.pose_cam[view, WRIST], coefficients, translation[view]])
        labels.append(
            {
                "seg": _segmentation(frame, view),
                "pose_y": np.repeat(_object(frame, view)[None], len(_OBJECTS), axis=0),
                "pose_m": pose[None].astype(np.float32),
                "joint_3d": frame.joints_cam[view][None].astype(np.float32),
                "joint_2d": (frame.keypoints_px[view][None] - 0.5).astype(np.float32),
            }
        )
    return labels


def _without_hand(label: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    absent = {name: np.full_like(label[name], _ABSENT) for name in ("joint_3d", "joint_2d")}
    return {
        **label,
        **absent,
        "pose_m": np.zeros_like(label["pose_m"]),
        "seg": np.zeros_like(label["seg"]),
    }


def _segmentation(frame: PlantedFrame, view: int) -> np.ndarray:
    """Return the outline of the hand, filled with the number that marks hands."""
    seg = np.zeros(SIZE_WH[::-1], np.uint8)
    outline = project_cam(frame.K[view], frame.vertices_cam[view])
    cv2.fillPoly(seg, [cv2.convexHull(np.round(outline).astype(np.int32))], 255)
    return seg


def _object(frame: PlantedFrame, view: int) -> Float[Array, "3 4"]:
    """Return T_cam_from_object of a thing in the hand."""
    place = frame.joints_cam[view].mean(0)
    return np.concatenate([np.eye(3), place[:, None]], axis=1).astype(np.float32)


def _write_sequence(
    folder: Path,
    subject: str,
    side: str,
    labels: list[list[dict[str, np.ndarray]]],
    shown: list[PlantedFrame],
) -> None:
    meta = {
        "extrinsics": _EXTRINSICS[subject],
        "mano_calib": [f"{subject}_{side}"],
        "mano_sides": [side],
        "num_frames": len(labels),
        "serials": list(SERIALS),
        "ycb_grasp_ind": 0,
        "ycb_ids": list(_OBJECTS),
    }
    save(folder / "meta.yml", _yaml(meta).encode())
    poses = np.array([label[0]["pose_m"] for label in labels], np.float32).reshape(-1, 1, 51)
    objects = np.tile(np.array([0, 0, 0, 1, 0, 0, 0.8], np.float32), (len(labels), len(_OBJECTS), 1))
    save(folder / "pose.npz", _npz({"pose_y": objects, "pose_m": poses}))
    depth = cv2.imencode(".png", np.full(SIZE_WH[::-1], 800, np.uint16))[1].tobytes()
    for number, (views, frame) in enumerate(zip(labels, shown, strict=True)):
        for serial, label, image in zip(SERIALS, views, frame.images, strict=True):
            save(folder / serial / f"color_{number:06d}.jpg", jpeg(image))
            save(folder / serial / f"aligned_depth_to_color_{number:06d}.png", depth)
            save(folder / serial / f"labels_{number:06d}.npz", _npz(label))


def _write_intrinsics(folder: Path, rig: Rig) -> None:
    for serial, K in zip(SERIALS, index_origin(rig.K).tolist(), strict=True):
        values = {"fx": K[0][0], "fy": K[1][1], "ppx": K[0][2], "ppy": K[1][2]}
        both = {"color": values, "depth": values}
        save(folder / f"{serial}_{SIZE_WH[0]}x{SIZE_WH[1]}.yml", _yaml(both).encode())


def _write_extrinsics(folder: Path, rig: Rig) -> None:
    T = rig.T_cam_from_world
    T_master_from_cam = T[SERIALS.index(MASTER)] @ invert_rigid(T)
    rows = {
        serial: one[:3].reshape(-1).tolist() for serial, one in zip(SERIALS, T_master_from_cam, strict=True)
    }
    rows["apriltag"] = T[SERIALS.index(MASTER)][:3].reshape(-1).tolist()
    save(folder / "extrinsics.yml", _yaml({"extrinsics": rows, "master": MASTER}).encode())


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def _yaml(value: Any, indent: str = "") -> str:
    """Write dictionaries of lists, strings and numbers in YAML's block form."""
    lines = []
    for key, item in value.items():
        name = _scalar(key)
        if isinstance(item, dict):
            lines.append(f"{indent}{name}:\n{_yaml(item, indent + '  ')}")
        elif isinstance(item, list):
            lines.append(f"{indent}{name}:\n" + "".join(f"{indent}- {_scalar(one)}\n" for one in item))
        else:
            lines.append(f"{indent}{name}: {_scalar(item)}\n")
    return "".join(lines)


def _scalar(value: Any) -> str:
    """Write one value; text that reads like a number is quoted."""
    if isinstance(value, str):
        return f"'{value}'" if value.replace("_", "").isdigit() else value
    return repr(value)
