"""Takes of 2D key points with known truth: a hand in natural poses before random cameras, no images.

For tests and benchmarks of what starts from key points. One hand a take, turned any way in every frame; the
cameras look at the origin from anywhere.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import rigid, rotate_points
from poem_jax.hand.model import HandModel, hand_mesh, mirror_pose
from poem_jax.hand.topology import NUM_SHAPES, ROOT_JOINT
from poem_jax.synthetic.poses import sample_pose
from poem_jax.typing import Array, Float

IMAGE_WH = (1280, 720)
FOCAL_PX = 900.0

_DISTANCE_M = (0.7, 1.2)
_PLACE_M = 0.08
"""Half the side of the cube around the origin in which the hand's root lies."""


class KeypointTake(NamedTuple):
    """What a detector saw, and the truth: float32, metres, world frame."""

    uv_px: Float[Array, "frame view 21 2"]
    K: Float[Array, "view 3 3"]
    T_cam_from_world: Float[Array, "view 4 4"]
    pose: Float[Array, "frame 16 3"]
    shape: Float[Array, "frame 10"]
    joints: Float[Array, "frame 21 3"]
    vertices: Float[Array, "frame 778 3"]


def draw_rig(
    rng: np.random.Generator, num_views: int
) -> tuple[Float[Array, "view 3 3"], Float[Array, "view 4 4"]]:
    """Draw K and T_cam_from_world of cameras in uniform directions, 0.7-1.2 m from the origin, any roll."""
    right, down, forward = np.moveaxis(Rotation.random(num_views, rng).as_matrix(), 1, 0)
    R_cam_from_world = np.stack([right, down, forward], axis=1)
    centres = -rng.uniform(*_DISTANCE_M, (num_views, 1)) * forward
    offset = -rotate_points(R_cam_from_world, centres[:, None])[:, 0]
    K = [[FOCAL_PX, 0, IMAGE_WH[0] / 2], [0, FOCAL_PX, IMAGE_WH[1] / 2], [0, 0, 1]]
    K = np.tile(np.asarray(K, np.float32), (num_views, 1, 1))
    return K, rigid(R_cam_from_world, offset).astype(np.float32)


def draw_keypoint_take(
    hand: HandModel,
    num_frames: int,
    num_views: int,
    noise_px: float,
    seed: int,
    *,
    outlier_share: float = 0.0,
    outlier_px: float = 50.0,
    own_shapes: bool = False,
) -> KeypointTake:
    """Draw a take.

    Args:
        hand: of either side; shape coefficients are drawn from N(0, 1).
        noise_px: standard deviation of each pixel coordinate.
        outlier_share: share of the key points that lie `outlier_px` off, in any direction.
        own_shapes: a new shape in every frame instead of one a take.
    """
    rng = np.random.default_rng(seed)
    pose = sample_pose(rng, num_frames)
    pose[:, 0] = Rotation.random(num_frames, rng).as_rotvec()
    pose = mirror_pose(pose) if hand.is_left else pose
    shape = rng.normal(size=(num_frames if own_shapes else 1, NUM_SHAPES))
    shape = np.broadcast_to(shape, (num_frames, NUM_SHAPES))
    place = rng.uniform(-_PLACE_M, _PLACE_M, (num_frames, 3))
    pose, shape, place = (np.asarray(array, np.float32) for array in (pose, shape, place))
    mesh = hand_mesh(hand, pose, shape, place, center_joint=ROOT_JOINT)
    K, T_cam_from_world = draw_rig(rng, num_views)
    uv, _ = project(K[None], T_cam_from_world[None], mesh.joints[:, None])
    uv = uv + noise_px * rng.normal(size=uv.shape)
    angle = rng.uniform(0, 2 * np.pi, uv.shape[:-1])
    off = rng.random(uv.shape[:-1]) < outlier_share
    uv = uv + outlier_px * off[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    uv = uv.astype(np.float32)
    return KeypointTake(
        uv, K, T_cam_from_world, pose, shape, np.asarray(mesh.joints), np.asarray(mesh.vertices)
    )
