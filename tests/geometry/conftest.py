"""Cameras around a hand-sized cloud of points, and float64 in JAX, for the laws of this room."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
import pytest

from poem_jax.geometry.cameras import Cameras

IMAGE_HW = (96, 128)
BATCHES = [(), (1,), (3, 1, 2)]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261122)


@pytest.fixture
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=BATCHES, ids=str)
def batch(request: pytest.FixtureRequest) -> tuple[int, ...]:
    return request.param


@pytest.fixture
def look_at(rng: np.random.Generator) -> Callable[..., Cameras]:
    """Return a maker of float64 cameras (*batch, view) that see the origin from all sides, with any roll."""

    def make(batch: tuple[int, ...] = (), num_views: int = 4) -> Cameras:
        shape = (*batch, num_views)
        forward = rng.normal(size=(*shape, 3))
        forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
        right = np.cross(rng.normal(size=(*shape, 3)), forward)
        right /= np.linalg.norm(right, axis=-1, keepdims=True)
        R = np.stack([right, np.cross(forward, right), forward], axis=-2)
        T = np.zeros((*shape, 4, 4))
        T[..., :3, :3], T[..., 2, 3], T[..., 3, 3] = R, rng.uniform(0.4, 1.0, shape), 1
        K = np.zeros((*shape, 3, 3))
        K[..., 0, 0], K[..., 1, 1] = rng.uniform(150, 300, shape), rng.uniform(150, 300, shape)
        K[..., 0, 1] = rng.uniform(-3, 3, shape)
        K[..., 0, 2], K[..., 1, 2] = rng.uniform(54, 74, shape), rng.uniform(40, 56, shape)
        K[..., 2, 2] = 1
        return Cameras(K, T)

    return make


@pytest.fixture
def cloud(rng: np.random.Generator) -> Callable[..., np.ndarray]:
    """Return a maker of points (*batch, point, 3) within 5 cm of the origin."""
    return lambda batch=(), num_points=5: rng.uniform(-0.05, 0.05, (*batch, num_points, 3))


@pytest.fixture
def check_gradients(x64: None, rng: np.random.Generator) -> Callable[..., None]:
    """Return a check, in float64, that forward, reverse and finite differences agree in a random
    direction."""

    def check(function: Callable[..., Any], *args: np.ndarray, eps: float = 1e-6, rtol: float = 5e-4) -> None:
        args = tuple(np.asarray(a, np.float64) for a in args)
        steps = tuple(rng.normal(size=a.shape) for a in args)
        forward = jax.jit(lambda a, t: jax.jvp(function, a, t))
        value, change = forward(args, steps)
        ahead = forward(tuple(a + eps * t for a, t in zip(args, steps, strict=True)), steps)[0]
        behind = forward(tuple(a - eps * t for a, t in zip(args, steps, strict=True)), steps)[0]
        expected = (ahead - behind) / (2 * eps)
        np.testing.assert_allclose(change, expected, rtol=rtol, atol=rtol * (1 + np.abs(expected).max()))
        weights = rng.normal(size=value.shape)
        pulled = jax.jit(lambda a, w: jax.vjp(function, *a)[1](w))(args, weights)
        along = sum(float(np.sum(p * t)) for p, t in zip(pulled, steps, strict=True))
        np.testing.assert_allclose(along, float(np.sum(weights * change)), rtol=1e-8, atol=1e-8)

    return check
