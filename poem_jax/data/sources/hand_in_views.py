"""From the labels of raw data sets to those of our frames: the user's hand file, pixels, camera frames.

Two kinds of raw labels exist. Some sets label a hand once, in a world, and give every camera's extrinsic
(ARCTIC, InterHand2.6M): `hand_in_views` takes it into each camera. Others label each view (DexYCB, HO-3D,
FreiHAND); they use the smaller functions here.

Pixels: the sets that are read calibrate with tools whose pixel (0, 0) is the *centre* of the first pixel;
ours spans [0, W] x [0, H]. `span_intrinsics` and `span_pixels` add the half pixel.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    matmul,
    rotation_from_axis_angle,
    transform_points,
)
from poem_jax.hand import mano_file
from poem_jax.hand.conventions import PoseComponents
from poem_jax.hand.model import HandMesh, HandModel, hand_mesh
from poem_jax.hand.topology import NUM_SKELETON_JOINTS
from poem_jax.typing import Array, Float


@dataclass(frozen=True)
class ManoFile:
    """The user's MANO file, read when it is first needed in a process: pickles hold only its path."""

    path: Path

    @classmethod
    def open(cls, path: str | Path, *, side: str = "right") -> "ManoFile":
        """Open a file and check that it is a hand of that side.

        Raises:
            FileNotFoundError: There is none; says where to get it.
            ValueError: It is no hand in MANO's schema, has no mean pose and components, or is of the other
                side.
        """
        made = cls(Path(path))
        if made.hand.side != side:
            raise ValueError(
                f"{path} must be a {side} hand (MANO_{side.upper()}.pkl); it is a {made.hand.side}"
            )
        return made

    @property
    def hand(self) -> HandModel:
        """The hand, float32."""
        return _hand(self.path)

    @property
    def components(self) -> PoseComponents:
        """Mean pose and principal components."""
        return _components(self.path)

    def mesh(
        self,
        pose: Float[Array, "*batch 16 3"],
        shape: Float[Array, "*batch 10"],
        translation: Float[Array, "*batch 3"] | None = None,
        *,
        wrist_at: Float[Array, "*batch 3"] | None = None,
        hand: HandModel | None = None,
    ) -> HandMesh:
        """Return vertices and joints, metres, in the frame into which `pose[..., 0, :]` turns.

        Args:
            pose: Axis-angle, MANO order, zero = flat hand.
            shape: Coefficients.
            translation: Added to MANO's own place of the hand (its layer without centring).
            wrist_at: Where the wrist joint comes to lie instead (its layer with `center_idx` 0).
            hand: Taken instead of the file's.
        """
        hand = self.hand if hand is None else hand
        pose, shape = np.asarray(pose, np.float32), np.asarray(shape, np.float32)
        if wrist_at is not None:
            return hand_mesh(hand, pose, shape, np.asarray(wrist_at, np.float32), center_joint=0)
        offset = None if translation is None else np.asarray(translation, np.float32)
        return hand_mesh(hand, pose, shape, offset)

    def add_mean(self, pose: Float[Array, "*batch 48"]) -> Float[Array, "*batch 16 3"]:
        """Return the pose, zero = flat hand, of 48 numbers that are relative to the mean (`flat_hand_mean`
        False without principal components)."""
        fingers = np.asarray(pose)[..., 3:] + self.components.mean
        whole = np.concatenate([np.asarray(pose)[..., :3], fingers], axis=-1)
        return whole.reshape(*whole.shape[:-1], NUM_SKELETON_JOINTS, 3).astype(np.float32)


@functools.lru_cache(maxsize=4)
def _hand(path: Path) -> HandModel:
    return mano_file.load(path)


@functools.lru_cache(maxsize=4)
def _components(path: Path) -> PoseComponents:
    return mano_file.load_pose_components(path)


class HandInViews(NamedTuple):
    """The labels of one hand in each camera's frame; see `MultiViewFrame`."""

    joints_cam: Float[Array, "view 21 3"]
    vertices_cam: Float[Array, "view 778 3"]
    pose_cam: Float[Array, "view 16 3"]
    shape: Float[Array, "view 10"]


def hand_in_views(
    T_cam_from_world: Float[Array, "view 4 4"],
    joints_world: Float[Array, "21 3"],
    vertices_world: Float[Array, "778 3"],
    pose_world: Float[Array, "16 3"],
    shape: Float[Array, "10"],
) -> HandInViews:
    """Take a hand of the world into the frame of each camera, float32.

    Args:
        T_cam_from_world: Rigid, metres.
        joints_world: OpenPose order, metres.
        vertices_world: Metres.
        pose_world: Axis-angle, zero = flat hand; `[0]` turns the hand into the world.
        shape: Coefficients.
    """
    T = np.asarray(T_cam_from_world, np.float64)
    views = len(T)
    poses = np.broadcast_to(np.asarray(pose_world, np.float64), (views, NUM_SKELETON_JOINTS, 3))
    return HandInViews(
        transform_points(T, np.asarray(joints_world, np.float64)).astype(np.float32),
        transform_points(T, np.asarray(vertices_world, np.float64)).astype(np.float32),
        turn_root(poses, T[:, :3, :3]).astype(np.float32),
        np.tile(np.asarray(shape, np.float32), (views, 1)),
    )


def turn_root(
    pose: Float[Array, "*batch 16 3"], R_new_from_old: Float[Array, "*batch 3 3"]
) -> Float[Array, "*batch 16 3"]:
    """Return the pose in a turned frame: the root becomes log(R exp(root)), the fingers stay."""
    root = axis_angle_from_rotation(matmul(R_new_from_old, rotation_from_axis_angle(pose[..., 0, :])))
    return np.concatenate([root[..., None, :], pose[..., 1:, :]], axis=-2)


def span_intrinsics(K_index: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Return K for an image that spans [0, W] x [0, H], from K for pixels whose integers are centres."""
    K = np.array(K_index, np.float64)
    K[..., :2, 2] += 0.5
    return K


def span_pixels(uv_index: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """Return pixels of an image that spans [0, W] x [0, H], from pixels whose integers are centres."""
    return np.asarray(uv_index, np.float64) + 0.5
