"""A planted take: two hands of the shipped model that move, one of them unseen for a while."""

import contextlib
from typing import NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.outputs.motion import take_motion
from poem_jax.capture.outputs.prediction import PredictionFile
from poem_jax.capture.take import Take
from poem_jax.geometry.upright import upright_rotation
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.poses import sample_pose
from tests.rigs import small_rig

HANDS = {side: default_hand(side) for side in ("right", "left")}
SIDES = ("right", "left")
FAR = np.array([500e3, 4500e3, 300.0])


class Planted(NamedTuple):
    take: Take
    frames: list
    pose: np.ndarray
    """(frame, hand, 16, 3)"""
    shape: np.ndarray
    vertices: np.ndarray
    joints: np.ndarray
    seen: np.ndarray
    time_s: np.ndarray
    origin: np.ndarray

    def prediction(self, path):
        """A file of results that holds the frames."""
        file = PredictionFile(path, self.take, self.origin)
        for frame in self.frames:
            file.add(frame)
        return file

    def motion(self, path):
        """The motion of the take, as it is read from the file of results."""
        with contextlib.closing(self.prediction(path)) as file:
            up = upright_rotation(self.take.rig.T_cam_from_world)
            names = self.take.hand_names
            return take_motion(file.names, names, SIDES, file.array, HANDS, self.origin, up)


def planted_take(count=9, *, pose=True, uneven=False, far=False):
    """A take; `pose` says whether the results hold the pose that their meshes are of."""
    rng = np.random.default_rng(5)
    keys = sample_pose(rng, 8).reshape(2, 4, 16, 3).swapaxes(0, 1)
    keys[:, 1, :, 1:] *= -1
    keys[:, :, 0] = rng.normal(size=(4, 2, 3))
    steps = rng.uniform(0.5, 1.5, count) if uneven else np.ones(count)
    time_s = 1e6 + np.cumsum(steps) / 25
    place = (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    poses = CubicSpline([0, 0.3, 0.7, 1.0], keys)(place)
    shape, spots = rng.normal(size=(2, 10)), rng.uniform(-0.1, 0.1, (count, 2, 3))
    seen = np.ones((count, 2), bool)
    seen[:2, 1] = seen[5, 1] = False
    meshes = [
        hand_mesh(HANDS[s], poses[:, i], np.tile(shape[i], (count, 1)), spots[:, i])
        for i, s in enumerate(SIDES)
    ]
    frames = []
    for index in range(count):
        results = []
        for hand, mesh in enumerate(meshes):
            if not seen[index, hand]:
                results.append(HandResult(np.zeros(3, bool), "unseen"))
                continue
            result = HandResult(
                np.ones(3, bool),
                vertices_world=mesh.vertices[index],
                joints_world=mesh.joints[index],
                root_world=mesh.joints[index, 9],
                reprojection_px=np.ones(3),
                joints_shown=np.ones(3),
                bridged=index == 4,
            )
            if pose:
                result = result._replace(
                    pose=poses[index, hand], shape=shape[hand], translation=spots[index, hand]
                )
            results.append(result)
        boxes = np.full((2, 3, 4), 1.0)
        frames.append(
            Frame(
                f"{index:04d}",
                boxes,
                images=(None,) * 3,
                hands=tuple(results),
                time_s=float(time_s[index]),
            )
        )
    vertices = np.stack([mesh.vertices for mesh in meshes], 1)
    joints = np.stack([mesh.joints for mesh in meshes], 1)
    origin = FAR if far else np.zeros(3)
    take = Take(small_rig(), SIDES, frames)
    return Planted(take, frames, poses, shape, vertices, joints, seen, time_s, origin)


@pytest.fixture
def planted():
    return planted_take
