"""A small rig with lenses, its cameras around the origin."""

import numpy as np
import pytest

from poem_jax.geometry.cameras import project
from poem_jax.geometry.distortion import distort_pixels
from poem_jax.geometry.rig import Rig
from tests.rigs import look_at, small_rig

NOISE_PX = 0.7
SIZE = np.array([1280, 720])


@pytest.fixture
def rig() -> Rig:
    return small_rig()


def make_ring(num_views: int) -> Rig:
    angles = 2 * np.pi * np.arange(num_views) / max(num_views, 5)
    heights = 0.35 + 0.15 * (np.arange(num_views) % 3)
    places = np.stack([0.9 * np.cos(angles), 0.9 * np.sin(angles), heights], -1)
    T = np.stack([look_at(place, np.zeros(3), 0.1 * i) for i, place in enumerate(places)])
    K = np.array([[900.0, 0, 647], [0, 903, 355], [0, 0, 1]])
    dist = np.array([-0.1, 0.02, 1e-3, -1e-3, 0.01])
    names = tuple(f"cam_{i}" for i in range(num_views))
    return Rig(
        names, np.tile(SIZE, (num_views, 1)), np.tile(K, (num_views, 1, 1)), np.tile(dist, (num_views, 1)), T
    )


def keypoints_of(rig: Rig, frames=6, seed=0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    hands = rng.uniform(-0.08, 0.08, (frames, 1, 1, 3)) + rng.uniform(-0.08, 0.08, (frames, 1, 21, 3))
    uv, _ = project(rig.K, rig.T_cam_from_world, hands.reshape(1, -1, 3))
    raw = distort_pixels(uv, rig.K, rig.dist).reshape(rig.num_views, frames, 1, 21, 2)
    return np.moveaxis(raw, 0, 2) + rng.normal(0, NOISE_PX, (frames, 1, rig.num_views, 21, 2))


@pytest.fixture
def ring():
    """Return a maker of rigs whose cameras stand around the origin: `ring(num_views)`."""
    return make_ring


@pytest.fixture
def seen():
    """Return a maker of raw key points of random hands near the origin: `seen(rig, frames)`."""
    return keypoints_of
