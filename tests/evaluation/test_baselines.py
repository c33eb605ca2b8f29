"""The baselines on hands whose answer is known."""

import numpy as np

from poem_jax.evaluation.baselines import mean_pose, mean_pose_rotated, noisy_dlt_roots
from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle, transform_points
from poem_jax.hand.topology import NUM_JOINTS, NUM_VERTICES, ROOT_JOINT

SAMPLES = 20


def stiff_hands(rotations: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One and the same hand, turned about its root and moved."""
    rng = np.random.default_rng(0)
    joints, vertices = (rng.normal(0, 0.05, (n, 3)) for n in (NUM_JOINTS, NUM_VERTICES))
    vertices, joints = vertices - joints[ROOT_JOINT], joints - joints[ROOT_JOINT]
    T = rigid(rotations, shifts)
    return transform_points(T, vertices[None]), transform_points(T, joints[None])


def random_placements() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.normal(0, 2, (SAMPLES, 3)), rng.normal(0, 1, (SAMPLES, 3))


def test_the_turned_mean_is_exact_for_a_stiff_hand() -> None:
    axis_angle, shifts = random_placements()
    vertices, joints = stiff_hands(rotation_from_axis_angle(axis_angle), shifts)
    np.testing.assert_allclose(mean_pose_rotated(vertices, joints, axis_angle), vertices, atol=1e-12)


def test_the_mean_pose_is_exact_where_nothing_turns_before_the_camera() -> None:
    axis_angle, shifts = random_placements()
    R = rotation_from_axis_angle(axis_angle)
    vertices, joints = stiff_hands(R, shifts)
    # Cameras that turn with the hand, wherever they stand.
    T_primary_from_world = rigid(np.swapaxes(R, -1, -2), shifts[::-1])
    np.testing.assert_allclose(mean_pose(vertices, joints, T_primary_from_world), vertices, atol=1e-12)


def test_the_mean_pose_shrinks_where_directions_are_uniform() -> None:
    axis_angle, shifts = random_placements()
    vertices, joints = stiff_hands(rotation_from_axis_angle(axis_angle), shifts)
    identity = np.broadcast_to(np.eye(4), (SAMPLES, 4, 4))
    sizes = [
        np.linalg.norm(points - joints[:, ROOT_JOINT, None], axis=-1).mean()
        for points in (mean_pose(vertices, joints, identity), vertices)
    ]
    assert sizes[0] < 0.5 * sizes[1]


def test_dlt_roots_are_exact_without_noise_and_absent_with_one_view() -> None:
    rng = np.random.default_rng(2)
    R = rotation_from_axis_angle(rng.normal(0, 2, (SAMPLES, 4, 3)))
    T = rigid(R, np.broadcast_to(np.array([0, 0, 0.8]), (SAMPLES, 4, 3))).astype(np.float32)
    K = np.broadcast_to(np.array([[150, 0, 64], [0, 150, 64], [0, 0, 1]], np.float32), (SAMPLES, 4, 3, 3))
    root = rng.normal(0, 0.05, (SAMPLES, 3)).astype(np.float32)
    root_px, _ = project(K, T, np.broadcast_to(root[:, None, None], (SAMPLES, 4, 1, 3)))
    noise = np.zeros((SAMPLES, 4, 2), np.float32)
    np.testing.assert_allclose(noisy_dlt_roots(root_px[:, :, 0], K, T, noise), root, atol=1e-4)
    alone = noisy_dlt_roots(root_px[:, :1, 0], K[:, :1], T[:, :1], noise[:, :1])
    assert np.isnan(alone).all()
    noisy = noisy_dlt_roots(root_px[:, :, 0], K, T, rng.standard_normal(noise.shape, dtype=np.float32))
    assert 0.001 < np.linalg.norm(noisy - root, axis=-1).mean() < 0.05
