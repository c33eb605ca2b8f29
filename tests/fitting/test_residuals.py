"""Laws of every residual: zero at the truth, right sign, gradient against finite differences (float64)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.fitting import Observations, anatomy_loss, residuals
from poem_jax.fitting.kinematics import (
    keypoint_model,
    pose_keypoints,
    pose_keypoints_of_rotations,
)
from poem_jax.hand.joint_limits import POSE_LIMITS
from poem_jax.hand.mano_file import load
from poem_jax.hand.model import HandModel


@pytest.fixture(autouse=True)
def _float64(float64):
    return


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def check_gradient(cost, x, rng, rtol=1e-5):
    """Compare the gradient along random directions with central differences."""
    x = jnp.asarray(x, jnp.float64)
    gradient = jax.jit(jax.grad(cost))(x)
    cost = jax.jit(cost)
    for _ in range(3):
        direction = rng.normal(size=x.shape)
        slope = (cost(x + 1e-6 * direction) - cost(x - 1e-6 * direction)) / 2e-6
        np.testing.assert_allclose(np.sum(gradient * direction), slope, rtol=rtol, atol=1e-6)


def test_reprojection(takes, rng):
    take = takes(2, 3, 0.0, 1)
    joints, uv, K, T = (
        np.asarray(x, float) for x in (take.joints, take.uv_px, take.K, take.T_cam_from_world)
    )
    weights = np.full(uv.shape[:-1], 0.25)

    def residual(joints):
        return residuals.reprojection(joints, Observations(uv, weights, K, T))

    assert float(jnp.abs(residual(joints)).max()) < 1e-3
    right = joints + 0.01 * T[0, 0, :3]
    assert float(residual(right)[:, 0, :, 0].min()) > 0, (
        "a joint moved to a camera's right projects further right"
    )
    assert float(jnp.abs(residuals.reprojection(joints + 1, Observations(uv, 0 * weights, K, T))).max()) == 0
    check_gradient(lambda x: jnp.sum(residual(x) ** 2), joints + 0.01 * rng.normal(size=joints.shape), rng)


def test_joints_3d(rng):
    target = rng.normal(size=(4, 21, 3))
    mask = np.arange(21) != 3
    mask = np.broadcast_to(mask, (4, 21))
    assert float(jnp.abs(residuals.joints_3d(target, target, 0.01)).max()) == 0
    moved = residuals.joints_3d(target + 0.02, np.where(mask[..., None], target, np.nan), 0.01, mask)
    np.testing.assert_allclose(moved[:, 3], 0)
    np.testing.assert_allclose(moved[:, 4], 2)
    check_gradient(lambda x: jnp.sum(residuals.joints_3d(x, target, 0.01) ** 2), target + 0.1, rng)


def test_joint_limits(rng):
    middle = POSE_LIMITS.mean(-1)
    assert float(jnp.abs(residuals.joint_limits(middle, POSE_LIMITS)).max()) == 0
    assert float(residuals.joint_limits(POSE_LIMITS[..., 1] + 0.1, POSE_LIMITS).min()) > 0
    assert float(residuals.joint_limits(POSE_LIMITS[..., 0] - 0.1, POSE_LIMITS).max()) < 0
    x = middle + rng.normal(size=middle.shape)
    check_gradient(lambda x: jnp.sum(residuals.joint_limits(x, POSE_LIMITS) ** 2), x, rng)


def test_pose_prior(rng):
    middle = POSE_LIMITS.mean(-1)
    np.testing.assert_allclose(residuals.pose_prior(middle, POSE_LIMITS), 0, atol=1e-12)
    assert float(residuals.pose_prior(middle + 0.1, POSE_LIMITS).min()) > 0
    edge = residuals.pose_prior(POSE_LIMITS[..., 1], POSE_LIMITS, min_sigma=0.0)
    np.testing.assert_allclose(edge, 1)
    check_gradient(lambda x: jnp.sum(residuals.pose_prior(x, POSE_LIMITS) ** 2), middle + 0.2, rng)


def test_shape_prior(rng):
    shape = rng.normal(size=10)
    assert float(jnp.abs(residuals.shape_prior(0 * shape)).max()) == 0
    check_gradient(lambda x: jnp.sum(residuals.shape_prior(x) ** 2), shape, rng)


def test_smoothness(rng):
    pose, wrist = np.tile(0.5 * rng.normal(size=(16, 3)), (3, 1, 1)), np.tile(rng.normal(size=3), (3, 1))
    still = residuals.smoothness(pose, wrist, 0.1, 0.01)
    np.testing.assert_allclose(still, 0, atol=1e-6)
    moved = residuals.smoothness(pose, wrist + 0.02 * np.arange(3)[:, None], 0.1, 0.01)
    np.testing.assert_allclose(moved[:, 48:], 2)
    x = pose + 0.1 * rng.normal(size=pose.shape)
    check_gradient(lambda x: jnp.sum(residuals.smoothness(x, jnp.asarray(wrist), 0.1, 0.01) ** 2), x, rng)


def test_geman_mcclure(rng):
    square = np.linspace(0, 1e4, 50)
    value = residuals.geman_mcclure(square, 3.0)
    assert float(value[0]) == 0
    assert float(value.max()) < 9
    np.testing.assert_allclose(
        residuals.geman_mcclure_weight(square, 3.0),
        jax.vmap(jax.grad(residuals.geman_mcclure), (0, None))(jnp.asarray(square), 3.0),
        rtol=1e-12,
    )


def anatomy_of(model, quaternions, shape):
    rotations = anatomy_loss.rotations_from_raw_quaternions(quaternions)
    posed = pose_keypoints_of_rotations(model, rotations, shape)
    return anatomy_loss.anatomy_terms(quaternions, shape, posed.rotations, posed.points, model.hand.is_left)


def test_anatomy_vanishes_for_the_flat_hand(model64):
    flat = jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (16, 1))
    for term in anatomy_of(model64, flat, jnp.zeros(10)):
        assert float(term) == pytest.approx(0, abs=1e-12)


def test_anatomy_punishes_what_it_says(model64):
    """Bending a finger joint about l is free of b, u and l; turning it about the bone or backwards is not."""
    rest = pose_keypoints(model64, jnp.zeros((16, 3)), jnp.zeros(10))
    axes = anatomy_loss.bone_axes(rest.rotations, rest.points)

    def turned(axis, angle):
        half = angle / 2
        quaternions = jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (16, 1))
        q = jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis[1]])
        return anatomy_of(model64, quaternions.at[2].set(q), jnp.zeros(10))

    bent, twisted, back = (turned(axis, jnp.asarray(0.5)) for axis in (axes.l, axes.b, -axes.l))
    assert float(bent.b + bent.u + bent.l) < 1e-6
    assert float(twisted.b) == pytest.approx(0.1, abs=1e-6), "one of ten restricted joints, cos = 1"
    assert float(back.l) == pytest.approx(0.4, abs=1e-6), "(cos - 1)^2 / 10 at cos = -1"
    assert float(turned(axes.l, jnp.asarray(np.pi / 2 + 0.3)).angle) == pytest.approx(0.09 / 15, abs=1e-6)


def test_a_left_hands_terms_are_those_of_its_mirror_image(model64, rng):
    quaternions = np.tile([1.0, 0, 0, 0], (16, 1)) + 0.3 * rng.normal(size=(16, 4))
    shape, mirror = rng.normal(size=10), np.diag([-1.0, 1, 1])
    posed = pose_keypoints_of_rotations(
        model64, anatomy_loss.rotations_from_raw_quaternions(quaternions), jnp.asarray(shape)
    )
    left = anatomy_loss.anatomy_terms(
        quaternions * [1, 1, -1, -1], shape, mirror @ posed.rotations @ mirror, posed.points @ mirror, True
    )
    np.testing.assert_allclose(left, anatomy_of(model64, quaternions, shape), rtol=1e-9)


def test_anatomy_gradients(model64, rng):
    quaternions = np.tile([1.0, 0, 0, 0], (16, 1)) + 0.3 * rng.normal(size=(16, 4))
    shape = jnp.asarray(rng.normal(size=10))
    for name in anatomy_loss.AnatomyTerms._fields:
        check_gradient(lambda q, name=name: getattr(anatomy_of(model64, q, shape), name), quaternions, rng)


@pytest.mark.parity
def test_anatomy_is_the_release(shared_dir):
    """Joints, the three axes of every bone, axis and angle of every turn, and the six terms of four poses."""
    folder = shared_dir / "reference" / "poem_v1"
    golden = {name: array.astype(float) for name, array in np.load(folder / "golden_fit.npz").items()}
    hand = load(folder / "fake_mano.npz")
    model = keypoint_model(HandModel(*(a.astype(float) if a.dtype.kind == "f" else a for a in hand)))
    quaternions, shape = golden["anat/pose"].reshape(4, 16, 4), golden["anat/shape"]
    rotations = anatomy_loss.rotations_from_raw_quaternions(quaternions)
    posed = pose_keypoints_of_rotations(model, rotations, shape)
    axes = anatomy_loss.bone_axes(posed.rotations, posed.points)
    turns = anatomy_loss.axis_angle_from_raw_quaternion(quaternions)[:, 1:]
    axis, angle = anatomy_loss.axis_and_angle(turns)
    found = {
        "joints": posed.points,
        "b_axis": axes.b,
        "u_axis": axes.u,
        "l_axis": axes.l,
        "axis": axis,
        "angle": angle,
    }
    for name, array in found.items():
        np.testing.assert_allclose(array, golden[f"anat/{name}"], rtol=1e-5, atol=2e-6, err_msg=name)
    terms = anatomy_of(model, quaternions, shape)
    for i in range(4):
        np.testing.assert_allclose([term[i] for term in terms], golden[f"anat/terms_{i}"], rtol=1e-5)
