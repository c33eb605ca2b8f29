"""A tiny FreiHAND v2: layout of `docs/datasets.md` and of the toolbox (github.com/lmb-freiburg/freihand).

    FreiHAND_v2/training/{rgb, mask}/%08d.jpg, FreiHAND_v2/evaluation/{rgb/%08d.jpg, segmap/%08d.png}
    FreiHAND_v2/{training, evaluation}_{K, scale}.json, FreiHAND_v2/training_{xyz, verts, mano}.json
    FreiHAND_v2_eval/evaluation_{K, scale, xyz, verts, mano}.json

Lengths are metres in the camera's frame, joints in OpenPose's order: the posed skeleton with the second set
of tip vertices. A row of MANO numbers is 48 pose (fingers relative to the mean), 10 shape, the middle
knuckle's pixel and focal length over its depth. Pixels have their origin at the centre of the first one. As
in the real set, every training sample has four pictures with other backgrounds: sample i of n has those
numbered i, i + n, i + 2n, i + 3n, with masks of the first n alone.
"""

from pathlib import Path

import cv2
import numpy as np

from poem_jax.geometry.cameras import project_cam
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.miniatures.files import save, save_json
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand
from poem_jax.miniatures.scene import (
    PlantedFrame,
    anchored,
    draw_rig,
    index_origin,
    jpeg,
    plant,
    png,
    with_mesh_tips,
)
from poem_jax.typing import Array, UInt8

SIZE_WH = (224, 224)
NUM_BACKGROUNDS = 4


def write(root: Path, *, frames: int = 2, seed: int = 0) -> list[PlantedFrame]:
    """Write a tiny FreiHAND below `root` and return its samples: training, then evaluation.

    Args:
        root: the folder that will hold `FreiHAND_v2` and `FreiHAND_v2_eval`.
        frames: of either set; of a training sample the first picture is returned.
        seed: of all chance.
    """
    root = Path(root)
    training = [_plant((seed, 20, n), f"training/{n:08d}") for n in range(frames)]
    evaluation = [_plant((seed, 21, n), f"evaluation/{n:08d}") for n in range(frames)]
    data = root / "FreiHAND_v2"
    for number, frame in enumerate(training):
        save(data / "training" / "mask" / f"{number:08d}.jpg", jpeg(_mask(frame)))
        for background in range(NUM_BACKGROUNDS):
            name = f"{number + background * len(training):08d}.jpg"
            save(data / "training" / "rgb" / name, jpeg(_recoloured(frame, background)))
    for number, frame in enumerate(evaluation):
        save(data / "evaluation" / "rgb" / f"{number:08d}.jpg", jpeg(frame.images[0]))
        save(data / "evaluation" / "segmap" / f"{number:08d}.png", png(_mask(frame)))
    _write_labels(data, "training", training, ("K", "scale", "xyz", "verts", "mano"))
    _write_labels(data, "evaluation", evaluation, ("K", "scale"))
    _write_labels(root / "FreiHAND_v2_eval", "evaluation", evaluation, ("K", "scale", "xyz", "verts", "mano"))
    return training + evaluation


def _plant(seed: tuple[int, ...], hint: str) -> PlantedFrame:
    rig = draw_rig(seed, ("0",), SIZE_WH, distance_m=(0.6, 0.8), field_of_view_deg=(25.0, 28.0))
    frame = plant(seed, rig, stand_in_hand(), key_hint=hint, spread_m=0.01)
    return anchored(with_mesh_tips(frame), 0)


def _write_labels(folder: Path, split: str, frames: list[PlantedFrame], names: tuple[str, ...]) -> None:
    labels = {
        "K": [index_origin(frame.K[0]).tolist() for frame in frames],
        "scale": [_scale(frame) for frame in frames],
        "xyz": [frame.joints_cam[0].tolist() for frame in frames],
        "verts": [frame.vertices_cam[0].tolist() for frame in frames],
        "mano": [[_mano(frame)] for frame in frames],
    }
    for name in names:
        save_json(folder / f"{split}_{name}.json", labels[name])


def _scale(frame: PlantedFrame) -> float:
    """Return the length of the middle finger's first bone."""
    joints = frame.joints_cam[0]
    return float(np.linalg.norm(joints[ROOT_JOINT + 1] - joints[ROOT_JOINT]))


def _mano(frame: PlantedFrame) -> list[float]:
    wrist, fingers = frame.pose_cam[0, 0], frame.pose_cam[0, 1:].reshape(-1)
    focal = (frame.K[0, 0, 0] + frame.K[0, 1, 1]) / 2
    root = [*(frame.keypoints_px[0, ROOT_JOINT] - 0.5), focal / frame.joints_cam[0, ROOT_JOINT, 2]]
    return np.concatenate([wrist, fingers - stand_in_components().mean, frame.shape, root]).tolist()


def _mask(frame: PlantedFrame) -> UInt8[Array, "h w 3"]:
    mask = np.zeros((*SIZE_WH[::-1], 3), np.uint8)
    outline = project_cam(frame.K[0], frame.vertices_cam[0])
    cv2.fillPoly(mask, [cv2.convexHull(np.round(outline).astype(np.int32))], (255, 255, 255))
    return mask


def _recoloured(frame: PlantedFrame, background: int) -> UInt8[Array, "h w 3"]:
    """Return the picture with other colours around the hand; background 0 is as it was taken."""
    image = frame.images[0].copy()
    outside = _mask(frame)[..., 0] == 0
    image[outside] = np.roll(image[outside], background, axis=-1) if background < 3 else 255 - image[outside]
    return image
