import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.models.hand_output import pose_by_joints

HAND = default_hand()
REST = hand_mesh(HAND, np.zeros((16, 3), np.float32), np.zeros(10, np.float32))


def _posed(joints):
    return np.asarray(pose_by_joints(HAND, REST.vertices, REST.joints, np.asarray(joints, np.float32)))


def test_joints_at_rest_give_the_template():
    np.testing.assert_allclose(_posed(REST.joints[None])[0], REST.vertices, atol=1e-5)


def test_result_moves_with_the_joints():
    R = rotation_from_axis_angle(np.array([1.0, -2.0, 0.5]))
    bent = hand_mesh(HAND, _bent(1), np.zeros((1, 10))).joints
    moved = bent @ R.T + np.array([0.1, -0.3, 0.8])
    np.testing.assert_allclose(_posed(moved), _posed(bent) @ R.T + [0.1, -0.3, 0.8], atol=1e-5)


def _bent(batch: int) -> np.ndarray:
    pose = np.zeros((batch, 16, 3))
    pose[:, 1:, 2] = np.random.default_rng(0).uniform(0.0, 0.9, (batch, 15))
    pose[:, 0] = np.random.default_rng(1).normal(size=(batch, 3))
    return pose


def test_true_joints_give_nearly_the_true_surface():
    mesh = hand_mesh(HAND, _bent(20), np.zeros((20, 10)))
    error = np.linalg.norm(_posed(mesh.joints) - mesh.vertices, axis=-1).mean()
    assert error < 2.5e-3


@pytest.mark.parametrize("joints", [np.zeros((1, 21, 3)), -REST.joints[None], 1e3 * REST.joints[None]])
def test_any_joints_are_safe(joints):
    def total(joints):
        return jnp.sum(pose_by_joints(HAND, REST.vertices, REST.joints, joints))

    value, gradient = jax.value_and_grad(total)(jnp.asarray(joints, jnp.float32))
    assert np.isfinite(value)
    assert np.isfinite(gradient).all()
