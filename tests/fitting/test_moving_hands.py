"""Hands between two moments: they go the shortest way, and keep what hands keep."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.fitting.moving_hands import MeshHand, ModelHand
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import BONES, INDEX_KNUCKLE, OPENPOSE_FROM_MANO, WRIST


def posed(seed: int, turn=None, side="right") -> ModelHand:
    rng = np.random.default_rng(seed)
    pose = 0.3 * rng.normal(size=(16, 3))
    pose[0] = rng.normal(size=3) if turn is None else turn
    return ModelHand.posed(default_hand(side), pose, rng.normal(size=10), rng.normal(size=3))


def mesh_of(hand: ModelHand) -> MeshHand:
    return MeshHand(hand.mesh.joints, hand.mesh.vertices)


def points(hand) -> np.ndarray:
    return np.concatenate(hand.mesh[::-1] if isinstance(hand, ModelHand) else (hand.joints, hand.points))


def moved(hand, R: Rotation, t: np.ndarray):
    """The same hand in a world that was moved."""
    if isinstance(hand, MeshHand):
        return MeshHand(R.apply(hand.joints) + t, R.apply(hand.points) + t)
    rotations = hand.rotations.copy()
    rotations[0] = R.as_matrix() @ rotations[0]
    return ModelHand(hand.model, rotations, hand.shape, R.apply(hand.wrist) + t, hand.offsets)


@pytest.mark.parametrize("kind", [mesh_of, lambda hand: hand])
def test_the_way_begins_at_one_hand_and_ends_at_the_other(kind):
    a, b = kind(posed(0)), kind(posed(1))
    np.testing.assert_allclose(points(a.towards(b, 0.0)), points(a), atol=1e-9)
    np.testing.assert_allclose(points(a.towards(b, 1.0)), points(b), atol=1e-9)
    np.testing.assert_allclose(points(a.towards(b, 0.3)), points(b.towards(a, 0.7)), atol=1e-9)


@pytest.mark.parametrize("kind", [mesh_of, lambda hand: hand])
def test_the_way_moves_with_the_world(kind):
    a, b = kind(posed(0)), kind(posed(1))
    R, t = Rotation.random(rng=3), np.array([1.0, -2.0, 3.0])
    np.testing.assert_allclose(
        points(moved(a, R, t).towards(moved(b, R, t), 0.3)), points(moved(a.towards(b, 0.3), R, t)), atol=1e-9
    )


@pytest.mark.parametrize("kind", [mesh_of, lambda hand: hand])
def test_a_turn_across_half_a_circle_takes_the_short_way(kind):
    """From 170 degrees to -170, by 180; a rigid hand stays rigid on the way.

    Of hands of points the joints' middle goes straight, where that of a hand model goes round the wrist.
    """
    axis = np.array([0, 0, 1.0])
    a, b = (kind(posed(0, np.deg2rad(angle) * axis)) for angle in (170, -170))
    half, expected = points(a.towards(b, 0.5)), points(kind(posed(0, np.pi * axis)))
    if isinstance(a, MeshHand):
        half, expected = (x - x[:21].mean(0) for x in (half, expected))
    np.testing.assert_allclose(half, expected, atol=1e-6)


def test_a_hand_model_keeps_the_lengths_of_its_bones():
    """Between two poses of one shape; a hand of points is bound to lose some."""
    a = posed(0)
    b = ModelHand(a.model, posed(1).rotations, a.shape, posed(1).wrist)
    start, end = np.array(BONES).T
    lengths = [
        np.linalg.norm(h.mesh.joints[end] - h.mesh.joints[start], axis=-1) for h in (a, a.towards(b, 0.5))
    ]
    skeleton = np.setdiff1d(np.arange(20), np.arange(3, 20, 4))
    np.testing.assert_allclose(lengths[0][skeleton], lengths[1][skeleton], atol=1e-9)


@pytest.mark.parametrize("side", ["right", "left"])
def test_pose_shape_and_place_stay_those_of_the_mesh(side):
    half = posed(0, side=side).towards(posed(1, side=side), 0.5)
    mesh = hand_mesh(default_hand(side), half.pose, half.shape, half.translation)
    np.testing.assert_allclose(mesh.vertices, half.mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(mesh.joints, half.mesh.joints, atol=1e-6)
    order = list(OPENPOSE_FROM_MANO)
    np.testing.assert_allclose(half.markers[order], half.mesh.joints, atol=0.003)
    tips = np.arange(4, 21, 4)
    np.testing.assert_allclose(
        *(np.delete(x, tips, 0) for x in (half.markers[order], mesh.joints)), atol=1e-6
    )


def test_what_the_detector_sees_is_carried_by_the_bones():
    """An offset of the wrist's bone turns with the hand, one of a finger with the finger."""
    rest = ModelHand.posed(default_hand(), np.zeros((16, 3)), np.zeros(10), np.zeros(3))
    assert rest.expected is None
    offsets = np.zeros((21, 3))
    offsets[[WRIST, INDEX_KNUCKLE, INDEX_KNUCKLE + 1]] += [0, 0, 0.01]
    seen = ModelHand.posed(default_hand(), np.zeros((16, 3)), np.zeros(10), np.zeros(3), offsets)
    np.testing.assert_allclose(seen.expected, rest.mesh.joints + offsets, atol=1e-12)
    bent = np.zeros((16, 3))
    bent[1, 0] = np.pi / 2
    bent = ModelHand.posed(default_hand(), bent, np.zeros(10), np.zeros(3))
    turned = replace(seen, rotations=bent.rotations)
    offsets = turned.expected - turned.mesh.joints
    np.testing.assert_allclose(offsets[[WRIST, INDEX_KNUCKLE]], np.tile([0, 0, 0.01], (2, 1)), atol=1e-9)
    np.testing.assert_allclose(np.abs(offsets[INDEX_KNUCKLE + 1]), [0, 0.01, 0], atol=1e-9)
