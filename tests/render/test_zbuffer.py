import numpy as np
import pytest

from poem_jax.render.zbuffer import NO_FACE, Raster, rasterise


def naive(vertices_px, faces, hw):
    """One pixel and one face at a time, straight from the definition."""
    best = np.full(hw, np.inf)
    index = np.full(hw, NO_FACE)
    weights = np.zeros((*hw, 3))
    for row, col in np.ndindex(*hw):
        for i, face in enumerate(faces):
            corners = vertices_px[face]
            system = np.vstack([corners[:, :2].T, np.ones(3)])
            if abs(np.linalg.det(system)) < 1e-12:
                continue
            screen = np.linalg.solve(system, [col + 0.5, row + 0.5, 1.0])
            if screen.min() < 0:
                continue
            depth = 1 / np.sum(screen / corners[:, 2])
            if depth < best[row, col]:
                best[row, col], index[row, col] = depth, i
                weights[row, col] = screen / corners[:, 2] * depth
    return Raster(index, weights, best)


def random_scene(rng, num_faces=12, size=20.0):
    vertices = rng.uniform([-5, -5, 0.3], [size + 5, size + 5, 1.5], (3 * num_faces, 3))
    return vertices, np.arange(3 * num_faces).reshape(-1, 3)


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_a_naive_rasteriser(seed):
    vertices, faces = random_scene(np.random.default_rng(seed))
    got, want = rasterise(vertices, faces, (18, 23)), naive(vertices, faces, (18, 23))
    np.testing.assert_array_equal(got.face_index, want.face_index)
    np.testing.assert_allclose(got.depth, want.depth, rtol=1e-5)
    np.testing.assert_allclose(got.barycentric, want.barycentric, atol=1e-5)


def test_weights_give_back_the_point_on_the_surface():
    """Perspective-correct weights of the corners in space reproject to the pixel centre."""
    corners_cam = np.array([[-0.3, -0.2, 0.5], [0.9, 0.1, 2.0], [-0.1, 0.6, 0.9]])
    focal, centre = 20.0, 16.0
    vertices = np.column_stack([focal * corners_cam[:, :2] / corners_cam[:, 2:] + centre, corners_cam[:, 2]])
    raster = rasterise(vertices, np.array([[0, 1, 2]]), (32, 32))
    row, col = np.nonzero(raster.face_index == 0)
    points = raster.barycentric[row, col] @ corners_cam
    uv = focal * points[:, :2] / points[:, 2:] + centre
    assert len(row) > 50
    np.testing.assert_allclose(uv, np.column_stack([col + 0.5, row + 0.5]), atol=1e-3)
    np.testing.assert_allclose(points[:, 2], raster.depth[row, col], rtol=1e-5)


def test_faces_that_share_an_edge_leave_no_hole():
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(9)), -1).reshape(-1, 2) * 4.0
    inside = (grid > 0).all(-1) & (grid < 32).all(-1)
    grid[inside] += rng.uniform(-1.5, 1.5, (inside.sum(), 2))
    vertices = np.column_stack([grid, np.ones(len(grid))])
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 9], -1), np.stack([corner + 1, corner + 10, corner + 9], -1)]
    )
    assert (rasterise(vertices, faces, (32, 32)).face_index != NO_FACE).all()


def test_the_order_of_faces_does_not_matter():
    vertices, faces = random_scene(np.random.default_rng(0))
    order = np.random.default_rng(1).permutation(len(faces))
    straight, shuffled = rasterise(vertices, faces, (20, 20)), rasterise(vertices, faces[order], (20, 20))
    np.testing.assert_array_equal(straight.depth, shuffled.depth)
    hit = straight.face_index != NO_FACE
    np.testing.assert_array_equal(order[shuffled.face_index[hit]], straight.face_index[hit])


def test_empty_behind_and_far_off_faces():
    vertices = np.array(
        [[1.0, 1.0, -0.5], [9.0, 1.0, 1.0], [1.0, 9.0, 1.0], [1e12, 1e12, 1.0], [np.nan, 2, 1]]
    )
    faces = np.array([[0, 1, 2], [1, 2, 4]])
    raster = rasterise(vertices, faces, (10, 10))
    assert (raster.face_index == NO_FACE).all()
    assert np.isinf(raster.depth).all()
    huge = rasterise(vertices, np.array([[1, 2, 3]]), (10, 10))
    assert (huge.face_index == 0).any()
    assert (rasterise(vertices, np.zeros((0, 3), np.int32), (4, 4)).face_index == NO_FACE).all()


def test_a_face_outside_the_vertices_is_refused():
    with pytest.raises(ValueError, match="from 0 to 2; got 0 to 3"):
        rasterise(np.ones((3, 3)), np.array([[0, 1, 3]]), (4, 4))
