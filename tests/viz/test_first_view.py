"""From where a page first looks."""

import numpy as np

from poem_jax.geometry.cameras import project
from poem_jax.viz.first_view import initial_view, view_camera
from tests.viz.pages import cameras, hand

WINDOW_HW = (720, 960)


def test_the_first_view_shows_the_hand_from_among_the_cameras():
    vertices = hand()
    T = np.stack([camera.T_cam_from_world for camera in cameras()])
    view = initial_view(vertices, T)
    K, T_view_from_world = view_camera(view, WINDOW_HW)
    np.testing.assert_allclose(T_view_from_world[:3, :3] @ T_view_from_world[:3, :3].T, np.eye(3), atol=1e-12)
    uv, depth = project(K, T_view_from_world, vertices)
    assert (depth > 0).all()
    size = uv.max(0) - uv.min(0)
    assert 0.12 * WINDOW_HW[0] < size.max() < 0.5 * WINDOW_HW[0]
    middle = project(K, T_view_from_world, view.look_at[None])[0][0]
    np.testing.assert_allclose(middle, [480, 360])
    # Up in the cameras is up in the picture.
    above = project(K, T_view_from_world, view.look_at[None] + [0, 0, 0.1])[0][0]
    assert above[1] < 360
    toward = [-(c.T_cam_from_world[:3, :3].T @ c.T_cam_from_world[:3, 3]) - view.look_at for c in cameras()]
    cosines = [direction @ (view.position - view.look_at) for direction in toward]
    assert max(cosines) < 0.97 * 0.8 * np.linalg.norm(view.position - view.look_at)


def test_opposite_cameras_have_an_up_too():
    T = np.stack([np.eye(4), np.diag([1.0, -1, -1, 1])])
    view = initial_view(hand(), T)
    assert np.isfinite(view.position).all()
    np.testing.assert_allclose(np.linalg.norm(view.up), 1)
