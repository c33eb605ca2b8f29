"""Poses in MANO's principal components and in SMPL-X's convention, and back."""

import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.hand.conventions import PoseComponents, SmplxHand, from_smplx, to_smplx
from poem_jax.hand.mano_file import load, load_pose_components
from poem_jax.hand.model import hand_mesh, mirror, mirror_pose
from poem_jax.hand.template import default_hand

RNG = np.random.default_rng(0)
POSE = RNG.normal(scale=0.4, size=(3, 16, 3)).astype(np.float32)
SPACE = PoseComponents(
    RNG.normal(scale=0.2, size=45).astype(np.float32),
    np.linalg.qr(RNG.normal(size=(45, 45)))[0].astype(np.float32),
)


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_all_components_give_the_pose_back(array):
    pose = array(POSE)
    coefficients = SPACE.coefficients(pose, 45)
    np.testing.assert_allclose(SPACE.pose(pose[:, 0], coefficients), POSE, atol=1e-5)


def test_few_components_are_the_nearest_pose_of_their_kind():
    fingers = POSE[:, 1:].reshape(3, 45)
    few = SPACE.pose(POSE[:, 0], SPACE.coefficients(POSE, 6))[:, 1:].reshape(3, 45)
    left = fingers - few
    np.testing.assert_allclose(left @ SPACE.components[:6].T, 0, atol=1e-5)
    assert np.linalg.norm(left) < np.linalg.norm(fingers - SPACE.mean)


def test_zero_coefficients_are_the_mean():
    pose = SPACE.pose(np.zeros(3, np.float32), np.zeros(6, np.float32))
    np.testing.assert_allclose(pose[1:].ravel(), SPACE.mean, atol=1e-7)


@pytest.mark.parametrize("count", [0, 46])
def test_a_wrong_number_of_components_is_refused(count):
    with pytest.raises(ValueError, match="from 1 to 45"):
        SPACE.coefficients(POSE, count)


@pytest.mark.parametrize("side", ["right", "left"])
def test_smplx_and_back(side):
    hand = to_smplx(POSE, SPACE.mean, side=side)
    np.testing.assert_allclose(from_smplx(hand, SPACE.mean, side=side), POSE, atol=1e-6)
    rest = SmplxHand(np.zeros((1, 3), np.float32), np.zeros((1, 45), np.float32))
    mean = SPACE.mean.reshape(15, 3)
    expected = mean if side == "right" else mean * [1, -1, -1]
    np.testing.assert_allclose(from_smplx(rest, SPACE.mean, side=side)[0, 1:], expected, atol=1e-7)


def test_the_same_smplx_numbers_mirrored_are_the_mirrored_hand():
    """A left hand's numbers are the right one's with y and z negated, and give its mirror image."""
    right = default_hand()
    hand = to_smplx(POSE, SPACE.mean, side="right")
    signs = np.array([1, -1, -1], np.float32)
    mirrored = SmplxHand(hand.global_orient * signs, hand.hand_pose * np.tile(signs, 15))
    pose = from_smplx(mirrored, SPACE.mean, side="left")
    np.testing.assert_allclose(pose, mirror_pose(POSE), atol=1e-6)
    betas = np.zeros((3, 10), np.float32)
    left = hand_mesh(mirror(right), pose, betas).vertices
    np.testing.assert_allclose(left, hand_mesh(right, POSE, betas).vertices * [-1, 1, 1], atol=1e-6)


def test_an_unknown_side_is_refused():
    with pytest.raises(ValueError, match="right"):
        to_smplx(POSE, SPACE.mean, side="both")


def test_the_pose_space_is_read_from_a_file(tmp_path):
    hand = default_hand()._asdict()
    fields = {"f" if name == "faces" else name: value for name, value in hand.items() if name != "is_left"}
    path = tmp_path / "hand.npz"
    np.savez(path, **fields, hands_mean=SPACE.mean, hands_components=SPACE.components)
    found = load_pose_components(path)
    np.testing.assert_array_equal(found.mean, SPACE.mean)
    np.testing.assert_array_equal(found.components, SPACE.components)
    assert load(path).side == "right"
    np.savez(path, **fields, hands_mean=SPACE.mean)
    with pytest.raises(ValueError, match="missing: hands_components"):
        load_pose_components(path)
