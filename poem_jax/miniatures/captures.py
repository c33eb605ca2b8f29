"""A tiny capture in our own format: `rig.json`, `frames/`, and `labels.npz` as `poem fit` writes it."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.calibration.rig_json import write_rig
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    invert_rigid,
    rotation_from_axis_angle,
    transform_points,
)
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import WRIST
from poem_jax.miniatures.files import save
from poem_jax.miniatures.scene import PlantedFrame, draw_rig, jpeg, plant

CAMERAS = ("cam_0", "cam_1", "cam_2", "cam_3")
SIZE_WH = (320, 240)


def write(root: Path, *, frames: int = 4, seed: int = 0) -> list[PlantedFrame]:
    """Write a take of one right hand by four cameras into `root` and return what it shows.

    Args:
        root: the capture's folder.
        frames: of the take.
        seed: of all chance.
    """
    root = Path(root)
    rig = draw_rig((seed, 40), CAMERAS, SIZE_WH)
    shown = [
        plant((seed, 41, number), rig, default_hand(), key_hint=f"{number:04d}") for number in range(frames)
    ]
    for frame in shown:
        for camera, image in zip(CAMERAS, frame.images, strict=True):
            save(root / "frames" / frame.key_hint / f"{camera}.jpg", jpeg(image))
    without_lens = np.zeros((len(CAMERAS), 5))
    write_rig(root / "rig.json", Rig(CAMERAS, rig.size_wh, rig.K, without_lens, rig.T_cam_from_world))
    stream = io.BytesIO()
    np.savez(stream, hand_side=["right"], frames=[frame.key_hint for frame in shown], **_labels(shown))
    save(root / "labels.npz", stream.getvalue())
    return shown


def _labels(shown: list[PlantedFrame]) -> dict[str, Any]:
    """Return the hands of all frames in the world of the rig."""
    T_world_from_cam = invert_rigid(shown[0].T_cam_from_world[0])
    pose = np.stack([frame.pose_cam[0] for frame in shown])
    turned = T_world_from_cam[:3, :3] @ rotation_from_axis_angle(pose[:, WRIST])
    pose[:, WRIST] = axis_angle_from_rotation(turned)
    joints, vertices = (
        np.stack([transform_points(T_world_from_cam, getattr(frame, name)[0]) for frame in shown])
        for name in ("joints_cam", "vertices_cam")
    )
    fields = {
        "joints_world": joints,
        "vertices_world": vertices,
        "pose": pose,
        "shape": np.stack([frame.shape for frame in shown]),
    }
    return {name: values[:, None].astype(np.float32) for name, values in fields.items()}
