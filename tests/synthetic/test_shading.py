import numpy as np
import pytest

from poem_jax.geometry.cameras import project
from poem_jax.render.zbuffer import draw_faces, empty_buffers
from poem_jax.synthetic.shading import (
    NUM_ATTRIBUTES,
    NUM_MATERIAL,
    count_samples,
    cover,
    develop,
    lit_share,
    project_points,
    shade_over,
    vertex_normals,
    vertices_seen,
)
from poem_jax.synthetic.surfaces import unit_sphere

EVERYWHERE = np.array([-np.inf, -np.inf, np.inf, np.inf])


def test_normals_of_a_sphere_point_outwards():
    solid = unit_sphere()
    normals = np.empty_like(solid.vertices)
    vertex_normals(solid.vertices, solid.faces, normals)
    assert np.einsum("vi,vi->v", normals, solid.normals).min() > 0.99
    lonely = np.empty((1, 3))
    vertex_normals(np.zeros((1, 3)), np.zeros((0, 3), np.int32), lonely)
    np.testing.assert_array_equal(lonely, [[0, 0, 1]])


def test_projection_is_that_of_geometry():
    rng = np.random.default_rng(0)
    K = np.array([[500.0, 0, 60], [0, 510, 70], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, 3] = [0.1, -0.1, 3.0]
    points, got = rng.normal(size=(30, 3)) * 0.3, np.empty((30, 3))
    uv, depth = project(K, T, points)
    project_points(K, T, points, 2.0, got)
    np.testing.assert_allclose(got, np.column_stack([2 * uv, depth]), rtol=1e-9)


def square(z, low, high):
    """Two faces that fill [low, high]^2 of the image at depth z, seen from the front."""
    corners = [[low, low, z], [high, low, z], [high, high, z], [low, high, z]]
    return np.array(corners, float), np.array([[0, 2, 1], [0, 3, 2]], np.int32)


def shade(albedo, frame=EVERYWHERE, low=0.0, high=4.0, scale=2):
    """Draw a square of one colour under ambient white light before a background of bytes 255."""
    vertices, faces = square(1.0, low * scale, high * scale)
    attributes = np.zeros((4, NUM_ATTRIBUTES), np.float32)
    attributes[:, 5], attributes[:, 6:9] = -1, albedo
    face_index, inverse_depth = empty_buffers((4 * scale, 4 * scale))
    draw_faces(vertices, faces, 0, True, 0.01, face_index, inverse_depth)
    surface = (faces, np.zeros(2, np.int32), attributes, np.zeros((1, NUM_MATERIAL), np.float32))
    ambient = np.array([[0, 0, 1], [1, 1, 1], [1, 1, 1]], np.float32)
    lighting = (np.zeros((0, 6), np.float32), ambient, np.zeros(3, np.float32))
    background, tones = np.full((4, 4, 3), 255, np.uint8), np.ones((256, 3), np.float32)
    image = np.empty((4, 4, 3), np.float32)
    raster = (vertices, face_index, inverse_depth)
    shade_over(surface, lighting, raster, scale, frame, background, tones, image)
    return image


def test_white_light_shows_the_surfaces_colour():
    np.testing.assert_allclose(shade([0.2, 0.4, 0.6]), np.broadcast_to([0.2, 0.4, 0.6], (4, 4, 3)), rtol=1e-5)


def test_pixels_mix_by_coverage_and_the_frame_ends_in_black():
    image = shade([0.0, 0.0, 0.0], high=2.5)
    np.testing.assert_allclose(image[0, :, 0], [0, 0, 0.5, 1])
    np.testing.assert_allclose(image[2, 2], 0.75)
    cut = shade([0.5, 0.5, 0.5], frame=np.array([1.0, 0.0, 4.0, 3.0]))
    assert (cut[:, 0] == 0).all()
    assert (cut[3] == 0).all()
    np.testing.assert_allclose(cut[:3, 1:], 0.5)


def test_coverage_counts_inside_the_frame():
    face_index = np.array([[0, 0, 5, -1], [0, 1, 5, -1]], np.int32)
    coverage = np.empty((1, 2), np.float32)
    assert count_samples(face_index, 2) == 4
    assert cover(face_index, 2, 2, EVERYWHERE, coverage) == 4
    np.testing.assert_array_equal(coverage, [[1, 0]])
    assert cover(face_index, 6, 2, np.array([1.0, 0.0, 2.0, 1.0]), coverage) == 2
    np.testing.assert_array_equal(coverage, [[0, 0.5]])


def test_vertices_behind_others_or_outside_are_not_seen():
    _, inverse_depth = empty_buffers((8, 8))
    inverse_depth[:, :4] = 1 / 0.5
    points = np.array(
        [[2, 2, 0.5], [2, 2, 0.503], [2, 2, 0.6], [6, 6, 0.6], [6, 6, -1], [9, 6, 0.6], [7.5, 1, 1]]
    )
    seen = np.empty(len(points), bool)
    vertices_seen(points, inverse_depth, 2, np.array([0.0, 0.0, 3.5, 4.0]), 0.004, seen)
    np.testing.assert_array_equal(seen, [True, True, False, True, False, False, False])


def test_shadows_fall_behind():
    inverse_depth = np.full((8, 8), 1 / 10.0, np.float32)
    inverse_depth[:, :4] = 1 / 9.9
    lit = np.empty(3)
    lit_share(np.array([[1.0, 4, 10.0], [6.5, 4, 10.0], [4.0, 4, 10.0]]), inverse_depth, 0.005, lit)
    np.testing.assert_allclose(lit, [0, 1, 2 / 3])


@pytest.mark.parametrize("noise", [0.0, 8.0])
def test_development(noise):
    image = np.full((100, 100, 3), 0.5, np.float32)
    curve = np.linspace(0, 255, 1024)
    first, second = np.empty((2, 100, 100, 3), np.uint8)
    gains = np.array([0.5, 1.0, 4.0])
    develop(image, gains, curve, noise, 7, first)
    develop(image, gains, curve, noise, 7, second)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_allclose(first[..., :2].mean((0, 1)), [63.75, 127.5], atol=0.6)
    assert first[..., 2].mean() > 250
    assert first[..., 1].std() == pytest.approx(noise, abs=0.3)
    if noise:
        develop(image, gains, curve, noise, 12, second)
        assert (first != second).mean() > 0.5
        residual = first[..., 1].astype(float) - 127.5
        assert abs(np.corrcoef(residual[:, 1:].ravel(), residual[:, :-1].ravel())[0, 1]) < 0.03
