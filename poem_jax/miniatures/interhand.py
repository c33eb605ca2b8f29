"""A tiny InterHand2.6M v1.0: layout of mks0601.github.io/InterHand2.6M and the repository's tools.

    images/<split>/Capture<c>/<sequence>/cam<camera>/image<frame>.jpg
    annotations/{skeleton, subject}.txt
    annotations/<split>/InterHand2.6M_<split>_{data, camera, joint_3d, MANO_NeuralAnnot}.json

World and camera positions are millimetres, x_cam = camrot (x_world - campos). 42 joints: the right hand,
then the left one, each finger from its tip to its base, the wrists last (20 and 41). MANO's pose is that
of the world, axis-angle less the mean pose; `trans` is metres and added to a hand that is not centred.
Pixels have their origin at the centre of the first one. Cameras 41.... are grey.

The joints were marked by people or by a network, not taken from the mesh: here all but the wrist lie some
millimetres off. Not planted, but present: a left hand, two hands, a right hand whose joints are not all
valid, and one without a fit of MANO.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.geometry.transforms import transpose
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import WRIST
from poem_jax.miniatures.files import save, save_json
from poem_jax.miniatures.labels import joints_world, moved_fingers, pose_world
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand
from poem_jax.miniatures.scene import PlantedFrame, Rig, draw_rig, index_origin, jpeg, plant, take_views
from poem_jax.typing import Array, Float

CAMERAS = (
    *("400002", "400004", "400009", "400012", "400013", "400015"),
    *("410001", "410003", "410014", "410028"),
)
SIZES_WH = ((334, 512), (512, 334))
"""Cameras stand upright or lie."""
INTERHAND_FROM_OPENPOSE = (4, 3, 2, 1, 8, 7, 6, 5, 12, 11, 10, 9, 16, 15, 14, 13, 20, 19, 18, 17, 0)
"""The key point at each place of InterHand's order."""
_FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")
_MM = 1000


class _Kind(NamedTuple):
    sequence: str
    hand_type: str
    valid: tuple[bool, bool]
    """Of the right hand's joints, of the left one's."""
    fitted: tuple[bool, bool]
    """Whether MANO fits them."""


_RIGHT = _Kind("0007_thumbup_normal", "right", (True, False), (True, False))
_DROPPED = (
    _Kind("0115_rocker_backside", "left", (False, True), (False, True)),
    _Kind("0266_dh_pray", "interacting", (True, True), (True, True)),
    _Kind("0011_thumbtucknormal", "right", (False, False), (True, False)),
    _Kind("0026_four_count", "right", (True, False), (False, False)),
)
_SPLITS = {"train": 7, "val": 0, "test": 4}
"""A capture of each."""


class _Shot(NamedTuple):
    """One frame of a capture."""

    number: int
    kind: _Kind
    frame: PlantedFrame
    """Of the right hand; the left one is its mirror image beside it."""


def write(root: Path, *, frames: int = 2, seed: int = 0) -> list[PlantedFrame]:
    """Write a tiny InterHand2.6M below `root` and return the single right hands that it shows.

    Args:
        root: the folder that holds `images` and `annotations`.
        frames: in train; val and test have one each. The second one is missing in one camera.
        seed: of all chance.

    Returns: train, val, test; all cameras of each, from which a reader draws some.
    """
    root = Path(root)
    planted: list[PlantedFrame] = []
    for order, (split, capture) in enumerate(_SPLITS.items()):
        rig = draw_rig((seed, 5, order), CAMERAS, [SIZES_WH[i % 3 == 2] for i in range(len(CAMERAS))])
        kinds = [_RIGHT] * (frames if split == "train" else 1) + list(_DROPPED if split == "train" else ())
        shots = [
            _shoot((seed, 5, order), rig, capture, 2017 + 6 * i, kind, missing=kind is _RIGHT and i == 1)
            for i, kind in enumerate(kinds)
        ]
        _write_split(root, split, capture, rig, shots)
        planted += [shot.frame for shot in shots if shot.kind is _RIGHT]
    save(root / "annotations" / "skeleton.txt", _skeleton().encode())
    save(
        root / "annotations" / "subject.txt",
        b"subject_id subject_directory gender\n0 m--20180226--0000 male\n",
    )
    return planted


def _shoot(
    seed: tuple[int, ...], rig: Rig, capture: int, number: int, kind: _Kind, *, missing: bool
) -> _Shot:
    hint = f"{capture}/{number}"
    if kind is not _RIGHT:
        return _Shot(number, kind, _unseen((*seed, number), rig, hint))
    frame = moved_fingers(plant((*seed, number), rig, stand_in_hand(), key_hint=hint), number)
    grey = [name.startswith("41") for name in frame.view_names]
    images = [_grey(image) if without else image for image, without in zip(frame.images, grey, strict=True)]
    frame = frame._replace(images=tuple(images))
    return _Shot(number, kind, take_views(frame, range(1, len(CAMERAS))) if missing else frame)


def _unseen(seed: tuple[int, ...], rig: Rig, hint: str) -> PlantedFrame:
    """Plant a hand of which no picture is drawn: two cameras, grey pictures."""
    few = Rig(*(part[:2] for part in rig))
    tiny = few._replace(size_wh=np.full((2, 2), 8))
    frame = plant(seed, tiny, stand_in_hand(), key_hint=hint)
    images = tuple(np.full((h, w, 3), 99, np.uint8) for w, h in few.size_wh.tolist())
    return frame._replace(size_wh=few.size_wh, images=images)


def _write_split(root: Path, split: str, capture: int, rig: Rig, shots: list[_Shot]) -> None:
    data: dict[str, list] = {"images": [], "annotations": []}
    for shot in shots:
        for view, camera in enumerate(shot.frame.view_names):
            name = f"Capture{capture}/{shot.kind.sequence}/cam{camera}/image{shot.number}.jpg"
            save(root / "images" / split / name, jpeg(shot.frame.images[view], 90))
            number = len(data["images"])
            data["images"].append(_image(shot, view, capture, camera, number, name))
            data["annotations"].append(_annotation(shot, view, number))
    K = index_origin(rig.K)
    R, t = rig.T_cam_from_world[:, :3, :3], rig.T_cam_from_world[:, :3, 3]
    cameras = {
        "campos": -_MM * (transpose(R) @ t[..., None])[..., 0],
        "camrot": R,
        "focal": K[:, (0, 1), (0, 1)],
        "princpt": K[:, :2, 2],
    }
    by_name = {key: dict(zip(CAMERAS, value.tolist(), strict=True)) for key, value in cameras.items()}
    hand, mean = stand_in_hand(), stand_in_components().mean.astype(np.float64)
    joints = {str(shot.number): _joints(shot) for shot in shots}
    mano = {str(shot.number): _mano(shot, hand, mean) for shot in shots}
    for kind, value in (
        ("data", data),
        ("camera", {str(capture): by_name}),
        ("joint_3d", {str(capture): joints}),
        ("MANO_NeuralAnnot", {str(capture): mano}),
    ):
        path = root / "annotations" / split / f"InterHand2.6M_{split}_{kind}.json"
        save_json(path, value)


def _image(shot: _Shot, view: int, capture: int, camera: str, number: int, name: str) -> dict[str, Any]:
    width, height = shot.frame.size_wh[view].tolist()
    return {
        "id": number,
        "file_name": name,
        "width": width,
        "height": height,
        "capture": capture,
        "subject": 0,
        "seq_name": shot.kind.sequence,
        "camera": camera,
        "frame_idx": shot.number,
    }


def _annotation(shot: _Shot, view: int, number: int) -> dict[str, Any]:
    """`joint_valid` here means: marked, and inside this picture."""
    uv, size = shot.frame.keypoints_px[view], shot.frame.size_wh[view]
    inside = ((uv >= 0) & (uv <= size)).all(-1)[list(INTERHAND_FROM_OPENPOSE)]
    valid = np.concatenate([inside & shot.kind.valid[0], inside & shot.kind.valid[1]])
    low, high = np.clip(uv.min(0) - 20.5, 0, size), np.clip(uv.max(0) + 19.5, 0, size)
    return {
        "id": number,
        "image_id": number,
        "bbox": [*low.tolist(), *(high - low).tolist()],
        "joint_valid": valid[:, None].astype(int).tolist(),
        "hand_type": shot.kind.hand_type,
        "hand_type_valid": 1,
    }


def _joints(shot: _Shot) -> dict[str, Any]:
    """Both hands in the world, millimetres; what was not marked is 1, 1, 1."""
    right = joints_world(shot.frame)[list(INTERHAND_FROM_OPENPOSE)]
    hands = [right, _beside(right)]
    for side, valid in enumerate(shot.kind.valid):
        if not valid:
            hands[side] = np.full((21, 3), 1 / _MM)
    return {
        "world_coord": (_MM * np.concatenate(hands)).tolist(),
        "joint_valid": [[valid] for valid in shot.kind.valid for _ in range(21)],
        "hand_type": shot.kind.hand_type,
        "hand_type_valid": True,
    }


def _beside(points: Float[Array, "point 3"]) -> Float[Array, "point 3"]:
    """Return the mirror image, 12 cm aside."""
    return points * [-1, 1, 1] + [0.12, 0, 0]


def _mano(shot: _Shot, hand: HandModel, mean: Float[Array, "45"]) -> dict[str, Any]:
    frame, pose = shot.frame, pose_world(shot.frame)
    rest = hand.J_regressor.astype(np.float64)[WRIST] @ (hand.v_template + hand.shapedirs @ frame.shape)
    fit = {
        "pose": [*pose[0].tolist(), *(pose[1:].reshape(-1) - mean).tolist()],
        "shape": frame.shape.tolist(),
        "trans": (joints_world(frame)[WRIST] - rest).tolist(),
    }
    left = {**fit, "trans": _beside(joints_world(frame)[WRIST][None])[0].tolist()}
    fits = zip(("right", "left"), (fit, left), shot.kind.fitted, strict=True)
    return {side: value if fitted else None for side, value, fitted in fits}


def _skeleton() -> str:
    """Name, number and parent of all joints."""
    lines = ["joint_name joint_id parent_id"]
    for side, first in (("R", 0), ("L", 21)):
        for finger, name in enumerate(_FINGERS):
            for step in range(4):
                joint = first + 4 * finger + step
                lines.append(f"{side}_{name}_{4 - step} {joint} {joint + 1 if step < 3 else first + 20}")
        lines.append(f"{side}_Wrist {first + 20} -1")
    return "\n".join(lines) + "\n"


def _grey(image: Array) -> Array:
    return np.repeat(image.mean(-1, keepdims=True).round().astype(np.uint8), 3, axis=-1)
