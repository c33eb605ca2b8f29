"""Samples: masks, and left hands as mirrored right ones."""

import numpy as np

from poem_jax.capture.boxes_file import read_boxes
from poem_jax.capture.folder import find_frames
from poem_jax.capture.samples import HandResult, make_sample, mirror_result, mirror_sample
from poem_jax.geometry.cameras import project
from poem_jax.hand.model import hand_mesh, mirror
from poem_jax.io.images import read_image

HW = (64, 64)


def sample_of(capture, rig, sides=None):
    (frame,) = find_frames(capture.folder, rig.names)
    images = [read_image(path, (240, 180)) for path in frame.images]
    hands = read_boxes(capture.folder / "boxes.npz")
    hands = hands if sides is None else hands._replace(hand_side=sides)
    return make_sample(images, rig, hands, 0, 0, HW)


def test_a_view_without_box_or_image_is_masked(make_capture, rig):
    capture = make_capture()
    (frame,) = find_frames(capture.folder, rig.names)
    images = [read_image(path, (240, 180)) for path in frame.images]
    hands = capture.hands._replace(boxes_px=capture.hands.boxes_px.copy())
    hands.boxes_px[0, 0, 1] = np.nan
    sample = make_sample([None, *images[1:]], rig, hands, 0, 0, HW)
    assert sample.view_mask.tolist() == [False, False, True]
    assert not sample.views[:2].any()
    np.testing.assert_array_equal(sample.K[0], np.eye(3))
    assert sample.views.dtype == np.uint8
    assert sample.K.dtype == np.float32


def test_left_hands_are_mirrored_and_back(make_capture, rig):
    capture = make_capture()
    right, left = sample_of(capture, rig), sample_of(capture, rig, ("left",))
    np.testing.assert_array_equal(left.views, right.views[:, :, ::-1])
    back = mirror_sample(left)
    for got, expected in zip(back, right, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-5)
    # Mirrored points land on the flipped pixels of their originals.
    joints = capture.joints_world[0, 0]
    mirrored = joints * [-1, 1, 1]
    for view in range(3):
        uv, depth = project(right.K[view], right.T_cam_from_world[view], joints)
        uv_left, depth_left = project(left.K[view], left.T_cam_from_world[view], mirrored)
        np.testing.assert_allclose(uv_left, np.stack([64 - uv[:, 0], uv[:, 1]], -1), atol=1e-3)
        np.testing.assert_allclose(depth_left, depth, rtol=1e-5)
        np.testing.assert_allclose(np.linalg.det(left.T_cam_from_world[view]), 1, rtol=1e-5)


def test_mirrored_parameters_belong_to_the_mirrored_hand():
    from poem_jax.hand.template import default_hand

    rng = np.random.default_rng(0)
    model = default_hand("right")
    pose, shape = rng.normal(size=(16, 3)) * 0.3, rng.normal(size=10)
    translation = rng.normal(size=3)
    mesh = hand_mesh(model, pose, shape, translation)
    result = HandResult(
        True, mesh.vertices, mesh.joints, mesh.joints[9], np.ones((3, 1, 2)), pose, shape, translation
    )
    left = mirror_result(result, 64)
    assert left.pose is not None
    assert left.shape is not None
    again = hand_mesh(mirror(model), left.pose, left.shape, left.translation)
    np.testing.assert_allclose(again.vertices, left.vertices_world, atol=1e-6)
    np.testing.assert_allclose(left.keypoints_px[0], [[63, 1]])
    twice = mirror_result(left, 64)
    np.testing.assert_allclose(twice.vertices_world, result.vertices_world)
    np.testing.assert_allclose(twice.keypoints_px, result.keypoints_px)
