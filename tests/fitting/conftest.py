from typing import NamedTuple

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.fitting.kinematics import KeypointModel, keypoint_model
from poem_jax.geometry.cameras import project
from poem_jax.hand.model import HandModel, hand_mesh, mirror_pose
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.poses import sample_pose


class Take(NamedTuple):
    """Key points of a synthetic take and its truth."""

    uv_px: np.ndarray
    K: np.ndarray
    T: np.ndarray
    pose: np.ndarray
    shape: np.ndarray
    joints: np.ndarray
    vertices: np.ndarray


def make_rig(rng: np.random.Generator, views: int) -> tuple[np.ndarray, np.ndarray]:
    """Cameras 1280 x 720, f = 900 px, all around and above the origin, 0.7-1.2 m away."""
    azimuth = 2 * np.pi * np.arange(views) / views + rng.uniform(-0.2, 0.2, views)
    height, distance = rng.uniform(0.2, 1.0, views), rng.uniform(0.7, 1.2, views)
    ground = np.stack([np.cos(azimuth), np.sin(azimuth)], -1) * np.cos(height)[:, None]
    centres = distance[:, None] * np.concatenate([ground, np.sin(height)[:, None]], -1)
    forward = -centres / distance[:, None]
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    T = np.tile(np.eye(4), (views, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, -np.einsum("vij,vj->vi", R, centres)
    K = np.tile(np.array([[900, 0, 640], [0, 900, 360], [0, 0, 1.0]]), (views, 1, 1))
    return K.astype(np.float32), T.astype(np.float32)


def make_take(
    frames: int,
    views: int,
    noise_px: float,
    seed: int,
    *,
    outliers: float = 0.0,
    hand: HandModel | None = None,
    own_shapes: bool = False,
) -> Take:
    """A hand in natural poses, each turned any way; outliers are 50 px off."""
    rng = np.random.default_rng(seed)
    hand = default_hand() if hand is None else hand
    pose = sample_pose(rng, frames)
    pose[:, 0] = Rotation.random(frames, random_state=seed).as_rotvec()
    pose = mirror_pose(pose) if hand.is_left else pose
    shape = np.broadcast_to(rng.normal(size=(frames if own_shapes else 1, 10)), (frames, 10))
    place = rng.uniform(-0.08, 0.08, (frames, 3))
    mesh = hand_mesh(hand, *(x.astype(np.float32) for x in (pose, shape, place)), center_joint=9)
    K, T = make_rig(rng, views)
    uv, _ = project(K[None], T[None], mesh.joints[:, None])
    uv = uv + noise_px * rng.normal(size=uv.shape)
    angle = rng.uniform(0, 2 * np.pi, uv.shape[:-1])
    off = rng.random(uv.shape[:-1]) < outliers
    uv = uv + 50 * off[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    return Take(uv.astype(np.float32), K, T, pose, shape, mesh.joints, mesh.vertices)


@pytest.fixture(scope="session")
def model() -> KeypointModel:
    return keypoint_model(default_hand())


def as_float64(hand: HandModel) -> HandModel:
    return HandModel(*(a.astype(np.float64) if a.dtype.kind == "f" else a for a in hand))


@pytest.fixture
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def takes():
    return make_take


@pytest.fixture
def model64() -> KeypointModel:
    return keypoint_model(as_float64(default_hand()))
