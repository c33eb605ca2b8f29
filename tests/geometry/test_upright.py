"""Which way is up."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.geometry.upright import mean_up, upright_rotation
from tests.rigs import small_rig


def test_a_world_of_a_camera_is_turned_half_about_x():
    np.testing.assert_allclose(upright_rotation(np.eye(4)[None]), np.diag([1.0, -1, -1]), atol=1e-12)


def test_up_does_not_depend_on_the_worlds_axes():
    T = small_rig().T_cam_from_world
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    before, after = upright_rotation(T), upright_rotation(T @ turn)
    np.testing.assert_allclose(after, before @ turn[:3, :3], atol=1e-12)
    np.testing.assert_allclose(before @ mean_up(T), [0, 1, 0], atol=1e-12)
    # What lies towards the first camera comes towards who looks along -z.
    towards = -T[0, 2, :3]
    assert (before @ towards)[2] > 0
    assert abs((before @ towards)[0]) < 1e-12


@pytest.mark.parametrize("turns", [[[90, 0, 0]], [[-90, 0, 0]], [[0, 0, 0], [0, 0, 180]]])
def test_it_is_a_rotation_whatever_the_cameras(turns):
    """Cameras that look straight down, or whose ups cancel out."""
    T = np.tile(np.eye(4), (len(turns), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("xyz", turns, degrees=True).as_matrix()
    R = upright_rotation(T)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
