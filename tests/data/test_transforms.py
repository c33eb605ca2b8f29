import numpy as np
import pytest

from poem_jax.data.transforms import box_from_center, jitter_box, square_box


@pytest.mark.parametrize("batch", [(), (3,), (2, 4)])
def test_square_box_surrounds_the_points(batch):
    points = np.random.default_rng(0).uniform(-50, 300, (*batch, 21, 2))
    box = square_box(points, 1.5)
    assert box.shape == (*batch, 4)
    size = box[..., 2:] - box[..., :2]
    np.testing.assert_allclose(size[..., 0], size[..., 1])
    extent = points.max(-2) - points.min(-2)
    np.testing.assert_allclose(size[..., 0], 1.5 * extent.max(-1))
    np.testing.assert_allclose((box[..., :2] + box[..., 2:]) / 2, (points.max(-2) + points.min(-2)) / 2)


def test_jitter_moves_by_shares_of_the_side():
    box = box_from_center(np.array([100.0, 50.0]), np.array(40.0))
    np.testing.assert_allclose(jitter_box(box, np.zeros(3), 0.05, 0.06), box)
    moved = jitter_box(box, np.array([1.0, -2.0, 0.5]), 0.05, 0.06)
    np.testing.assert_allclose((moved[:2] + moved[2:]) / 2, [102, 46])
    np.testing.assert_allclose(moved[2:] - moved[:2], 40 * 1.03)
    held = jitter_box(box, np.array([0.0, 0.0, -100.0]), 0.05, 0.06)
    np.testing.assert_allclose(held[2:] - held[:2], 20)
