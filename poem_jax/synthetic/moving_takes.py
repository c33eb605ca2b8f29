"""Takes of 2D key points of a hand that moves, with its truth: for tests and benchmarks of smoothing.

Place and turn of the hand are sums of swings whose periods do not fit together; the fingers go from one
natural pose to the next. All is a function of time, so that one motion may be seen at any moments.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from poem_jax.geometry.cameras import project
from poem_jax.hand.model import HandModel, hand_mesh, mirror_pose
from poem_jax.hand.topology import NUM_SHAPES, ROOT_JOINT
from poem_jax.synthetic.keypoint_takes import KeypointTake, draw_rig
from poem_jax.synthetic.poses import angles_to_pose, sample_angles
from poem_jax.typing import Float

_SWINGS_HZ = np.array([0.23, 0.41, 0.67, 1.0])
_PLACE_M = np.array([0.07, 0.06, 0.05, 0.04])
_TURN = np.array([0.4, 0.3, 0.2, 0.15])
"""Of the swings: metres, radians."""
_SECONDS_A_POSE = 0.6


class Motion:
    """The motion of one right hand: half a metre a second, now and then more than one, at pace 1."""

    def __init__(self, seed: int, pace: float = 1.0, seconds: float = 10.0) -> None:
        """Draw a motion.

        Args:
            seed: Of all that is drawn.
            pace: How fast the hand goes its way; at 0 it rests.
            seconds: How long it goes from pose to pose; later it keeps the last.
        """
        rng = np.random.default_rng(seed)
        self.shape = rng.normal(size=NUM_SHAPES).astype(np.float32)
        self._pace = pace
        self._turned = Rotation.random(rng=rng)
        self._phases = rng.uniform(0, 2 * np.pi, (2, len(_SWINGS_HZ), 3))
        poses = 2 + int(pace * seconds / _SECONDS_A_POSE)
        self._ends = _SECONDS_A_POSE * (poses - 1)
        angles = sample_angles(rng, poses)
        self._angles = PchipInterpolator(np.linspace(0, self._ends, poses), angles)

    def at(
        self, time_s: Float[np.ndarray, " frame"]
    ) -> tuple[Float[np.ndarray, "frame 16 3"], Float[np.ndarray, "frame 3"]]:
        """Return the pose, axis-angle, and the place of the root, metres, at any moments."""
        time = self._pace * np.asarray(time_s, np.float64)
        place, turn = (
            np.einsum(
                "s,fsx->fx", size, np.sin(2 * np.pi * _SWINGS_HZ[:, None] * time[:, None, None] + phase)
            )
            for size, phase in zip((_PLACE_M, _TURN), self._phases, strict=True)
        )
        pose = angles_to_pose(self._angles(np.clip(time, 0, self._ends)))
        pose[:, 0] = (Rotation.from_rotvec(turn) * self._turned).as_rotvec()
        return pose.astype(np.float32), place.astype(np.float32)


def see_motion(
    motion: Motion,
    hand: HandModel,
    time_s: Float[np.ndarray, " frame"],
    num_views: int,
    noise_px: float,
    seed: int,
) -> KeypointTake:
    """Look at a motion with random cameras.

    Args:
        motion: Mirrored for a left hand.
        hand: Of either side.
        time_s: The moments, seconds.
        num_views: Cameras.
        noise_px: Standard deviation of each pixel coordinate, anew at every moment.
        seed: Of cameras and noise.
    """
    rng = np.random.default_rng(seed)
    pose, place = motion.at(time_s)
    pose = mirror_pose(pose) if hand.is_left else pose
    shape = np.tile(motion.shape, (len(pose), 1))
    mesh = hand_mesh(hand, pose, shape, place, center_joint=ROOT_JOINT)
    K, T_cam_from_world = draw_rig(rng, num_views)
    uv, _ = project(K[None], T_cam_from_world[None], mesh.joints[:, None])
    uv = (uv + noise_px * rng.normal(size=uv.shape)).astype(np.float32)
    joints, vertices = (np.asarray(points, np.float32) for points in (mesh.joints, mesh.vertices))
    return KeypointTake(uv, K, T_cam_from_world, pose, shape, joints, vertices)
