"""Cameras around a hand: places uniform on the sphere, lenses, rolls, and the boxes of their crops.

Every number of view v comes from row v of one table of uniform numbers, drawn row by row: the first views
of a sample are the same however many there are.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from poem_jax.data.transforms import jitter_box, square_box
from poem_jax.geometry.cameras import crop_intrinsics, project
from poem_jax.geometry.transforms import (
    rigid,
    rotation_about_z,
    smallest_rotation,
    unit_vectors,
)
from poem_jax.synthetic.config import CameraConfig, CropConfig, Range, StandingCamera
from poem_jax.typing import Array, Float, Int

_NUMBERS = 16
"""Uniform numbers per view."""


class Viewpoints(NamedTuple):
    """Calibrated views of one scene, as full frames and as crops."""

    K_frame: Float[Array, "view 3 3"]
    frame_wh: Int[Array, "view 2"]
    T_cam_from_world: Float[Array, "view 4 4"]
    camera_world: Float[Array, "view 3"]
    """Optical centres."""
    box_px: Float[Array, "view 4"]
    """Where the crop lies in the full frame."""
    K_crop: Float[Array, "view 3 3"]
    frame_in_crop: Float[Array, "view 4"]
    """The full frame's extent (x0, y0, x1, y1) in crop pixels."""


def draw_viewpoints(
    cameras: CameraConfig,
    crop: CropConfig,
    rng: np.random.Generator,
    joints_world: Float[Array, "21 3"],
    num_views: int,
    out_hw: tuple[int, int],
) -> Viewpoints:
    """Draw cameras that look at a hand, or take those of the rig, and the jittered box of the hand in each.

    Raises:
        ValueError: more views than the rig has cameras.
    """
    numbers = rng.random((num_views, _NUMBERS))
    if cameras.rig:
        if num_views > len(cameras.rig):
            raise ValueError(
                f"`num_views` must be at most the rig's {len(cameras.rig)} cameras; got {num_views}"
            )
        placed = standing_cameras(cameras.rig[:num_views])
    else:
        placed = _drawn_cameras(cameras, numbers, joints_world.mean(0))
    K, frame_wh, T, camera_world = placed
    keypoints_px = project(K, T, np.broadcast_to(joints_world, (num_views, *joints_world.shape)))[0]
    box = square_box(keypoints_px, crop.expand_ratio)
    box = jitter_box(box, _normals(numbers[:, 12:16])[:, :3], crop.center_jitter, crop.scale_jitter)
    K_crop, frame = crop_intrinsics(K, box, out_hw), _frame(box, frame_wh, out_hw)
    return Viewpoints(K, frame_wh, T, camera_world, box, K_crop, frame)


_Placed: TypeAlias = tuple[
    Float[Array, "view 3 3"], Int[Array, "view 2"], Float[Array, "view 4 4"], Float[Array, "view 3"]
]
"""K, sizes of the full frames, T_cam_from_world, and optical centres."""


def standing_cameras(rig: Sequence[StandingCamera]) -> _Placed:
    """Return cameras that stand still: K, sizes of their frames, T_cam_from_world, and where they stand."""
    frame_wh = np.array([camera.frame_wh for camera in rig])
    focal = frame_wh.max(-1) / 2 / np.tan(np.radians([camera.field_of_view_deg for camera in rig]) / 2)
    K = np.zeros((len(rig), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = focal
    K[:, :2, 2] = frame_wh / 2
    K[:, 2, 2] = 1
    place = np.array([camera.place_m for camera in rig])
    forward = unit_vectors(np.array([camera.looks_at_m for camera in rig]) - place)
    # Upright: x lies level, so that y, which is down in the image, is down in the world.
    x = unit_vectors(np.cross(forward, [0.0, 0.0, 1.0]))
    level = np.stack([x, np.cross(forward, x), forward], axis=-2)
    R = rotation_about_z(np.radians([camera.roll_deg for camera in rig])) @ level
    return K, frame_wh, rigid(R, -np.einsum("vij,vj->vi", R, place)), place


def _drawn_cameras(
    cameras: CameraConfig, numbers: Float[Array, "view n"], target_world: Float[Array, "3"]
) -> _Placed:
    frame_wh = np.array(cameras.frames_wh)[(numbers[:, 0] * len(cameras.frames_wh)).astype(int)]
    K = _intrinsics(cameras, numbers[:, 1:6], frame_wh)
    direction = directions_on_sphere(numbers[:, 6], numbers[:, 7])
    camera_world = target_world + direction * within(cameras.distance_m, numbers[:, 8])[:, None]
    seen_at = frame_wh / 2 * (1 + cameras.aim_jitter * (2 * numbers[:, 9:11] - 1))
    roll = np.radians(within(cameras.roll_deg, numbers[:, 11]))
    R = _look_along(-direction, roll)
    R = smallest_rotation(np.array([0.0, 0.0, 1.0]), _rays(K, seen_at)) @ R
    return K, frame_wh, rigid(R, -np.einsum("vij,vj->vi", R, camera_world)), camera_world


def within(bounds: Range, uniform: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Map uniform numbers in [0, 1] into a range."""
    return bounds[0] + (bounds[1] - bounds[0]) * uniform


def directions_on_sphere(u: Float[Array, "*batch"], v: Float[Array, "*batch"]) -> Float[Array, "*batch 3"]:
    """Map two uniform numbers to a direction uniform on the sphere (Archimedes: its height is uniform)."""
    height, angle = 2 * np.asarray(u) - 1, 2 * np.pi * np.asarray(v)
    radius = np.sqrt(np.maximum(1 - height**2, 0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)


def _normals(uniform: Float[Array, "view 4"]) -> Float[Array, "view 4"]:
    """Turn pairs of uniform numbers into standard normal ones (Box and Muller 1958)."""
    radius = np.sqrt(-2 * np.log1p(-uniform[..., 0::2]))
    angle = 2 * np.pi * uniform[..., 1::2]
    return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def _intrinsics(
    cameras: CameraConfig, uniform: Float[Array, "view 5"], frame_wh: Int[Array, "view 2"]
) -> Float[Array, "view 3 3"]:
    longer = frame_wh.max(-1)
    normal = _normals(uniform[:, 1:])
    focal = longer / 2 / np.tan(np.radians(within(cameras.field_of_view_deg, uniform[:, 0])) / 2)
    K = np.zeros((len(frame_wh), 3, 3))
    K[:, 0, 0] = focal
    K[:, 1, 1] = focal * (1 + cameras.aspect_sigma * normal[:, 0])
    K[:, :2, 2] = frame_wh / 2 + cameras.principal_sigma * longer[:, None] * normal[:, 1:3]
    K[:, 2, 2] = 1
    return K


def _look_along(forward: Float[Array, "view 3"], roll: Float[Array, "view"]) -> Float[Array, "view 3 3"]:
    """Return R_cam_from_world of cameras whose z axis is `forward`, turned about it by `roll`."""
    aside = np.where(np.abs(forward[:, :1]) < 0.8, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x = unit_vectors(np.cross(aside, forward))
    return rotation_about_z(roll) @ np.stack([x, np.cross(forward, x), forward], axis=-2)


def _rays(K: Float[Array, "view 3 3"], uv_px: Float[Array, "view 2"]) -> Float[Array, "view 3"]:
    focal = np.stack([K[:, 0, 0], K[:, 1, 1]], axis=-1)
    return np.concatenate([(uv_px - K[:, :2, 2]) / focal, np.ones((len(K), 1))], axis=-1)


def _frame(
    box: Float[Array, "view 4"], frame_wh: Int[Array, "view 2"], out_hw: tuple[int, int]
) -> Float[Array, "view 4"]:
    scale = np.array(out_hw[::-1]) / (box[:, 2:] - box[:, :2])
    return np.concatenate([-box[:, :2] * scale, (frame_wh - box[:, :2]) * scale], axis=-1)
