"""Squares around hands."""

import numpy as np
import pytest

from poem_jax.data.crops import release_squares
from poem_jax.data.tar_labels import convention_of, frame_from_label, label_from_frame
from tests.data.one_frame import one_frame
from tests.data.released_labels import released_label


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_whole_centre_of_the_releases_stays_itself(dtype):
    """Not the pixel below, where rounding leaves the middle of a box a trace below it."""
    center = np.arange(1.0, 640.0)[:, None] * [1.0, -1.0]
    box = np.concatenate([center + 0.5 - 137.313 / 2, center + 0.5 + 137.313 / 2], -1).astype(dtype)
    squares = release_squares(box.reshape(-1, 2, 2).astype(np.float64), 1.0)
    np.testing.assert_array_equal(squares.center_px - 0.5, center)


def test_boxes_of_labels_are_read_and_packed_to_the_pixel():
    frame = one_frame(skew=0.0)
    label = released_label(frame, world_to_camera=False)
    centers = [np.array([301.0, 17.0]), np.array([222.0, 463.0]), np.array([5.0, 111.0])]
    label |= {"bbox_center": centers, "bbox_scale": [2 * 137.313] * 3}
    convention = convention_of("DexYCB_mv_")
    read = frame_from_label(label, frame.images, convention, path="a.tar", key="0")
    assert read.box_px is not None
    squares = release_squares(read.box_px.reshape(-1, 2, 2), 1.0)
    np.testing.assert_array_equal(squares.center_px - 0.5, centers)
    packed = label_from_frame(read, convention, index=0)
    np.testing.assert_array_equal(packed["bbox_center"], centers)
    np.testing.assert_allclose(packed["bbox_scale"], 2 * 137.313, atol=1e-4)
