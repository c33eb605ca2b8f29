"""Frustum grids and the codes of position: written formulae, and what masked views may not change."""

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.geometry.cameras import project
from poem_jax.models.frustum import (
    denormalised,
    frustum_channels,
    frustum_depths,
    frustum_grid,
    inverse_sigmoid,
    normalised,
    point_sine_code,
    sigmoid_step,
    view_row_column_code,
)
from poem_jax.models.frustum_config import Cuboid, DepthSteps, FrustumConfig
from poem_jax.models.point_features import ViewRowColumnCode

CUBOID = Cuboid((-1.2, -1.0, 0.2), (1.2, 1.4, 2.0))
MAP_HW, IMAGE_HW = (2, 4), (32, 32)


@pytest.mark.parametrize("steps", DepthSteps)
def test_depths_start_at_the_start_and_never_reach_the_end(steps):
    depths = frustum_depths(FrustumConfig(4, 0.2, 2.2, steps))
    expected = {
        DepthSteps.LINEAR: [0.2, 0.7, 1.2, 1.7],
        DepthSteps.LINEAR_INCREASING: [0.2, 0.4, 0.8, 1.4],
    }
    np.testing.assert_allclose(depths, expected[steps], atol=1e-6)


@pytest.mark.parametrize("cell_offset", [0.0, 0.5])
def test_grid_points_project_onto_their_cells_at_their_depths(make_scene, cell_offset):
    cams = make_scene(2, 3)[1]
    config = FrustumConfig(3, 0.1, 1.0, DepthSteps.LINEAR, cell_offset)
    grid = np.asarray(frustum_grid(config, cams, MAP_HW, IMAGE_HW))
    assert grid.shape == (2, 3, 4, 2, 3, 3)
    uv_px, depth = project(cams.K, cams.T_cam_from_world, grid.reshape(2, 3, -1, 3))
    uv_px, depth = uv_px.reshape(2, 3, 4, 2, 3, 2), depth.reshape(2, 3, 4, 2, 3)
    for w in range(4):
        np.testing.assert_allclose(uv_px[:, :, w, ..., 0], 8 * (w + cell_offset), atol=2e-3)
    for h in range(2):
        np.testing.assert_allclose(uv_px[:, :, :, h, :, 1], 16 * (h + cell_offset), atol=2e-3)
    for d, metres in enumerate(frustum_depths(config)):
        np.testing.assert_allclose(depth[..., d], metres, atol=1e-6)


def test_channels_are_logits_depth_by_depth(make_scene):
    grid = frustum_grid(FrustumConfig(3, 0.3, 1.0), make_scene(1, 2)[1], MAP_HW, IMAGE_HW)
    channels = frustum_channels(grid, CUBOID)
    assert channels.shape == (1, 2, 2, 4, 9)
    low, high = np.array(CUBOID.low), np.array(CUBOID.high)
    share = np.clip((np.asarray(grid, np.float64) - low) / (high - low), 1e-5, 1 - 1e-5)
    for d in range(3):
        for axis in range(3):
            expected = np.log(share / (1 - share))[..., d, axis].swapaxes(2, 3)
            np.testing.assert_allclose(channels[..., 3 * d + axis], expected, atol=1e-4)


def test_normalising_is_undone():
    points = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    np.testing.assert_allclose(denormalised(normalised(points, CUBOID), CUBOID), points, atol=1e-6)
    corners = normalised(np.array([CUBOID.low, CUBOID.high], np.float32), CUBOID)
    np.testing.assert_allclose(corners, [[0, 0, 0], [1, 1, 1]], atol=1e-6)


def test_inverse_sigmoid_is_finite_and_inverts():
    x = jnp.array([-3.0, 0.0, 0.1, 0.5, 0.9, 1.0, 7.0])
    limit = np.log(1e-5)
    expected = [limit, limit, np.log(1 / 9), 0, np.log(9), -limit, -limit]
    np.testing.assert_allclose(inverse_sigmoid(x), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sigmoid_step(x[2:5], 0.0 * x[2:5]), x[2:5], atol=1e-6)


def test_point_code_is_the_written_formula():
    width, p = 8, np.array([[0.25, -0.75, 1.5]], np.float32)
    expected = []
    for axis in (1, 0, 2):
        for i in range(width // 2):
            angle = 2 * np.pi * p[0, axis] / 10000 ** (2 * i / width)
            expected += [np.sin(angle), np.cos(angle)]
    np.testing.assert_allclose(point_sine_code(jnp.asarray(p), width)[0], expected, atol=1e-5)


def test_view_code_ignores_masked_views():
    whole = view_row_column_code(jnp.ones((1, 2), bool), MAP_HW, 8)
    masked = view_row_column_code(jnp.array([[False, True, False, True]]), MAP_HW, 8)
    assert masked.shape == (1, 4, *MAP_HW, 24)
    np.testing.assert_array_equal(masked[:, [1, 3]], whole)
    more = view_row_column_code(jnp.ones((1, 3), bool), MAP_HW, 8)
    assert np.abs(np.asarray(more[:, :2] - whole))[..., :8].max() > 0.1, "it tells how many views there are"


def test_view_code_is_what_the_mixed_code_mixes():
    mixed = ViewRowColumnCode(16, rngs=nnx.Rngs(0))
    mask = jnp.array([[True, True, False, True]])
    code = view_row_column_code(mask, MAP_HW, 8)
    found, expected = mixed(mask, MAP_HW), mixed.mix(code[0])[None]
    np.testing.assert_allclose(found[:, [0, 1, 3]], expected[:, [0, 1, 3]], atol=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FrustumConfig(0), "num_depths"),
        (lambda: FrustumConfig(4, 2.0, 1.0), "below `end`; got 2.0 and 1.0"),
        (lambda: FrustumConfig(cell_offset=1.0), "cell_offset"),
        (lambda: Cuboid((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)), "below `high`"),
    ],
)
def test_bad_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
