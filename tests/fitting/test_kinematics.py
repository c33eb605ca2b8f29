import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.fitting.kinematics import (
    keypoint_model,
    pose_jacobian,
    pose_keypoints,
    rest_wrist,
    shape_jacobian,
)
from poem_jax.geometry.transforms import axis_angle_from_rotation, rotation_from_axis_angle
from poem_jax.hand.model import HandModel, hand_mesh
from poem_jax.hand.template import default_hand


@pytest.mark.slow
@pytest.mark.parametrize("side", ["right", pytest.param("left", marks=pytest.mark.slow)])
def test_key_points_and_derivatives_are_those_of_the_mesh(side, float64):
    hand = HandModel(*(a.astype(float) if a.dtype.kind == "f" else a for a in default_hand(side)))
    model = keypoint_model(hand)
    rng = np.random.default_rng(0)
    pose, shape = jnp.asarray(0.6 * rng.normal(size=(2, 16, 3))), jnp.asarray(rng.normal(size=(2, 10)))
    posed = pose_keypoints(model, pose, shape)
    joints = hand_mesh(hand, pose, shape).joints
    np.testing.assert_allclose(posed.points, joints - joints[:, :1], atol=1e-9)
    np.testing.assert_allclose(rest_wrist(model, shape), joints[:, 0], atol=1e-12)

    def points(turn, shape):
        first = rotation_from_axis_angle(turn[:3]) @ rotation_from_axis_angle(pose[0, 0])
        fingers = pose[0, 1:] + turn[3:].reshape(15, 3)
        turned = jnp.concatenate([axis_angle_from_rotation(first)[None], fingers])
        return pose_keypoints(model, turned, shape).points

    by_turn, by_shape = jax.jacfwd(points, (0, 1))(jnp.zeros(48), shape[0])
    np.testing.assert_allclose(pose_jacobian(model, posed, pose)[0], by_turn, atol=1e-9)
    np.testing.assert_allclose(shape_jacobian(model, posed)[0], by_shape, atol=1e-9)
