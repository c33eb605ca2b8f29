import numpy as np
import pytest

from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.joint_limits import resting_fingers
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import BONES, SKELETON_JOINT_NAMES
from poem_jax.synthetic.finger_collisions import posed_fingers, segment_distance, smallest_gap
from poem_jax.synthetic.poses import (
    ANGLE_NAMES,
    FAMILIES,
    FAMILY_SHARES,
    POSE_LIMITS,
    angles_to_pose,
    joint_axes,
    pose_to_angles,
    sample_angles,
    sample_pose,
)

FINGERS = ("index", "middle", "ring", "little")
MIXTURE_OF_500 = (0.182332057098, 0.391594243202, -0.247094741179, -0.0258473433371, 1.2077293122)
"""Mean, standard deviation and three angles of `sample_angles(default_rng(0), 500)`."""


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def _flexion(angles: np.ndarray, joint: str) -> np.ndarray:
    return np.rad2deg(angles[:, SKELETON_JOINT_NAMES.index(joint) - 1, 0])


def test_limits_are_ranges_around_rest():
    assert POSE_LIMITS.shape == (15, 3, 2)
    assert ANGLE_NAMES[0] == "flexion"
    assert (POSE_LIMITS[..., 0] <= 0).all()
    assert (POSE_LIMITS[..., 1] > 0).all()


@pytest.mark.parametrize("family", [None, *FAMILIES])
def test_samples_keep_within_the_limits(rng, family):
    angles = sample_angles(rng, 200, family)
    assert angles.shape == (200, 15, 3)
    assert (angles >= POSE_LIMITS[..., 0] - 1e-12).all()
    assert (angles <= POSE_LIMITS[..., 1] + 1e-12).all()


def test_every_angle_spreads_over_its_limits(rng):
    spread = sample_angles(rng, 2000).std(axis=0)
    uniform = (POSE_LIMITS[..., 1] - POSE_LIMITS[..., 0]) / np.sqrt(12)
    assert (spread / uniform).min() > 0.6


def test_equal_generators_give_equal_poses():
    first, second = (sample_pose(np.random.default_rng(7), 20) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - sample_pose(np.random.default_rng(8), 20)).max() > 0.1


def test_angles_are_components_of_the_pose(rng):
    angles = sample_angles(rng, 12).reshape(3, 4, 15, 3)
    pose = angles_to_pose(angles)
    assert pose.shape == (3, 4, 16, 3)
    assert (pose[..., 0, :] == 0).all()
    np.testing.assert_allclose(pose_to_angles(pose), angles, atol=1e-12)
    axes = joint_axes()
    np.testing.assert_allclose(axes @ axes.mT, np.broadcast_to(np.eye(3), axes.shape), atol=1e-12)
    assert (np.linalg.det(axes) > 0).all()


def test_flexion_bends_into_the_palm_and_abduction_towards_the_thumb():
    hand, rest = default_hand(), resting_fingers(default_hand())
    for f, name in enumerate(("index", "middle", "little", "ring", "thumb")):
        for axis, direction in ((0, [0, -1.0, 0]), (1, [0, 0, 1.0])):
            if name == "thumb" and axis == 1:
                continue
            angles = np.zeros((1, 15, 3))
            angles[0, 3 * f, axis] = 0.2
            tip = posed_fingers(angles_to_pose(angles))[0, f, 3]
            assert (tip - rest[f, 3]) @ direction > 0.004, (name, axis)
    assert hand.side == "right"


def _joint_flexions(angles: np.ndarray, joint: str) -> np.ndarray:
    return np.stack([_flexion(angles, f"{name}_{joint}") for name in FINGERS], axis=1)


def _extended(angles: np.ndarray) -> np.ndarray:
    """Tell (sample, finger) whether a long finger is nearly straight."""
    return (_joint_flexions(angles, "mcp") <= 20) & (_joint_flexions(angles, "pip") <= 20)


def _curled(angles: np.ndarray) -> np.ndarray:
    return (_joint_flexions(angles, "mcp") >= 50) & (_joint_flexions(angles, "pip") >= 70)


def test_points_point(rng):
    angles = sample_angles(rng, 300, "point")
    pointing = _extended(angles)[:, 0] & _curled(angles)[:, 1:].all(axis=1)
    assert pointing.mean() >= 0.95
    fingers = posed_fingers(angles_to_pose(angles))
    reach = np.linalg.norm(fingers[:, :4, 3] - fingers[:, :4, 0], axis=-1)
    assert (reach[:, 0] == reach.max(axis=1)).all()


def test_fists_close_and_flat_hands_open(rng):
    assert _curled(sample_angles(rng, 300, "fist")).all(axis=1).mean() >= 0.95
    assert _extended(sample_angles(rng, 300, "flat")).all(axis=1).mean() >= 0.95


def test_counting_decides_finger_by_finger(rng):
    angles = sample_angles(rng, 600, "counting")
    assert (_extended(angles) | _curled(angles)).all(axis=1).mean() >= 0.95
    assert (np.abs(_extended(angles).mean(axis=0) - 0.55) < 0.12).all()
    assert len(np.unique(_extended(angles), axis=0)) == 16


def test_grasps_are_neither_open_nor_closed(rng):
    angles = sample_angles(rng, 300, "grasp")
    bend = sum(_joint_flexions(angles, joint) for joint in ("mcp", "pip", "dip"))
    assert ((bend > 40) & (bend < 230)).all(axis=1).mean() >= 0.95


def test_pinches_bring_the_thumb_near_a_tip_without_touching(rng):
    tips = posed_fingers(angles_to_pose(sample_angles(rng, 300, "pinch")))[:, :, 3]
    reach = 1e3 * np.linalg.norm(tips[:, :4] - tips[:, 4:], axis=-1).min(axis=1)
    # As measured: 28 mm between tips in the median, half of the poses below 30 mm, one in 25 below 20 mm.
    assert 24 < np.median(reach) < 32
    assert (reach < 30).mean() > 0.45
    assert (reach < 20).mean() < 0.12


def test_mixture_is_frozen(rng):
    """Models are trained on it: what was drawn before "point" came must be drawn still, number by number."""
    assert sum(FAMILY_SHARES) == pytest.approx(1)
    assert dict(zip(FAMILIES, FAMILY_SHARES, strict=True))["point"] == 0
    angles = sample_angles(rng, 500)
    np.testing.assert_allclose(
        [angles.mean(), angles.std(), angles[0, 0, 0], angles[250, 7, 1], angles[499, 14, 0]],
        MIXTURE_OF_500,
        rtol=1e-9,
    )


def test_unknown_families_are_named(rng):
    with pytest.raises(ValueError, match=r"`family` must be one of .*; got 'claw'"):
        sample_angles(rng, 1, "claw")


def test_samples_keep_their_fingers_apart(rng):
    fingers = posed_fingers(sample_pose(rng, 500))
    assert (smallest_gap(fingers) >= 0).mean() > 0.99


def test_capsule_skeleton_is_the_hands(rng):
    pose = sample_pose(rng, 4)
    fingers = posed_fingers(pose)
    joints = hand_mesh(default_hand(), pose, np.zeros((4, 10))).joints
    # Tips differ only by what skinning and pose corrections do to the tip vertex.
    for k, name in enumerate(("index", "middle", "little", "ring", "thumb")):
        f = ("thumb", "index", "middle", "ring", "little").index(name)
        np.testing.assert_allclose(fingers[:, k], joints[:, 4 * f + 1 : 4 * f + 5], atol=1e-3)
    assert len(BONES) == 20


def test_the_smallest_gap_sees_a_finger_in_another():
    rest = resting_fingers(default_hand())[None]
    assert smallest_gap(rest)[0] > 0
    crossed = rest.copy()
    crossed[0, 0] = crossed[0, 1] + np.array([0, 0, 0.004])
    assert smallest_gap(crossed)[0] < 0


def test_segment_distance_matches_a_dense_search(rng):
    p1, q1, p2, q2 = rng.normal(size=(4, 60, 3))
    t = np.linspace(0, 1, 201)[:, None]
    expected = [
        np.linalg.norm((a + t * (b - a))[:, None] - (c + t * (d - c))[None], axis=-1).min()
        for a, b, c, d in zip(p1, q1, p2, q2, strict=True)
    ]
    got = segment_distance(p1, q1, p2, q2)
    assert (got <= np.array(expected) + 1e-12).all()
    np.testing.assert_allclose(got, expected, atol=2e-2)
    # Parallel and crossing segments.
    zero, x, y = np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert segment_distance(*(p[None] for p in (zero, x, y, x + y)))[0] == pytest.approx(1)
    assert segment_distance(*(p[None] for p in (-x, x, -y, y)))[0] == pytest.approx(0)


def test_poses_are_rotations_below_half_a_turn(rng):
    pose = sample_pose(rng, 50)
    assert np.linalg.norm(pose, axis=-1).max() < np.pi
    R = rotation_from_axis_angle(pose)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-9)
