"""Overlays: pixels outside the mesh stay, depth decides, and nothing strange is drawn."""

import numpy as np

from poem_jax.viz.overlay import MeshInView, draw_overlay, silhouette

HW = (40, 60)
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def square(left, top, right, bottom, depth, rgb):
    px = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], np.float64)
    cam = np.concatenate([(px - 30) / 50 * depth, np.full((4, 1), depth)], axis=-1)
    return MeshInView(px, cam, QUAD, rgb)


def test_only_the_mesh_is_drawn_and_the_input_stays():
    image = np.full((*HW, 3), 90, np.uint8)
    mesh = square(10, 5, 30, 25.4, 1.0, (255, 0, 0))
    drawn = draw_overlay(image, [mesh])
    inside = silhouette([mesh], HW)
    assert inside.sum() == 20 * 20
    assert inside[5:25, 10:30].all()
    np.testing.assert_array_equal(drawn[~inside], 90)
    assert (drawn[inside, 0] > drawn[inside, 1]).all()
    assert (image == 90).all()


def test_the_nearer_mesh_hides_the_farther_in_any_order():
    image = np.zeros((*HW, 3), np.uint8)
    near = square(10, 5, 30, 25, 0.5, (255, 0, 0))
    far = square(20, 5, 50, 25, 1.0, (0, 0, 255))
    first, second = draw_overlay(image, [near, far]), draw_overlay(image, [far, near])
    np.testing.assert_array_equal(first, second)
    assert first[15, 25, 0] > 0
    assert first[15, 25, 2] == 0
    assert first[15, 40, 2] > 0


def test_nothing_behind_the_camera_or_undefined_is_drawn():
    image = np.full((*HW, 3), 7, np.uint8)
    behind = square(10, 5, 30, 25, -1.0, (255, 0, 0))
    undefined = square(10, 5, 30, np.nan, 1.0, (255, 0, 0))
    np.testing.assert_array_equal(draw_overlay(image, [behind, undefined]), image)
    np.testing.assert_array_equal(draw_overlay(image, []), image)
    assert not silhouette([], HW).any()
