"""A left hand given as the right hand that a mirror shows."""

import numpy as np
import pytest

from poem_jax.data.frames import check_frame
from poem_jax.data.right_hand import as_right_hand
from poem_jax.geometry.cameras import project, project_cam
from poem_jax.geometry.transforms import invert_rigid, transform_points
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from tests.data.one_frame import one_frame


@pytest.fixture(scope="module")
def left():
    frame = one_frame(side="left")
    low, high = frame.keypoints_px.min(1), frame.keypoints_px.max(1)
    return frame._replace(box_px=np.concatenate([low, high], -1))


def test_mirrored_points_are_seen_at_mirrored_pixels_also_with_a_skew(left):
    right = check_frame(as_right_hand(left), "memory")
    seen = project_cam(right.K, right.joints_cam)
    expected = np.stack(
        [2 * left.K[:, None, 0, 2] - left.keypoints_px[..., 0], left.keypoints_px[..., 1]], -1
    )
    np.testing.assert_allclose(seen, expected, atol=1e-9)
    np.testing.assert_allclose(right.keypoints_px, expected, atol=1e-9)
    np.testing.assert_array_equal(right.mirror_px, left.K[:, 0, 2])


def test_all_cameras_see_one_mirrored_hand(left):
    right = as_right_hand(left)
    world = transform_points(invert_rigid(right.T_cam_from_world), right.joints_cam)
    np.testing.assert_allclose(world, world[:1].repeat(3, 0), atol=1e-9)
    pixels, depth = project(right.K, right.T_cam_from_world, world[0])
    np.testing.assert_allclose(pixels, right.keypoints_px, atol=1e-7)
    assert (depth > 0).all()


def test_pose_and_shape_give_the_mirrored_vertices_by_the_right_hand_model(left):
    right = as_right_hand(left)
    mesh = hand_mesh(
        default_hand("right"), right.pose_cam, right.shape, right.joints_cam[:, 0], center_joint=0
    )
    np.testing.assert_allclose(mesh.vertices, right.vertices_cam, atol=1e-6)


def test_boxes_hold_the_mirrored_key_points_in_order(left):
    right = as_right_hand(left)
    expected = np.concatenate([right.keypoints_px.min(1), right.keypoints_px.max(1)], -1)
    np.testing.assert_allclose(right.box_px, expected, atol=1e-9)


def test_a_mirrored_frame_is_not_mirrored_again(left):
    with pytest.raises(ValueError, match="take/000001 is mirrored already"):
        as_right_hand(as_right_hand(left))


def test_labels_that_are_absent_stay_absent(left):
    right = as_right_hand(left._replace(pose_cam=None, shape=None, box_px=None))
    assert (right.pose_cam, right.shape, right.box_px) == (None, None, None)
