"""Crops: masks, the square about a hand, and how far a model widens it."""

import cv2
import numpy as np
import pytest

from poem_jax.capture.agreement import judge_boxes
from poem_jax.capture.crop import crop_hands, hand_squares
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.data.lens import project_raw
from poem_jax.geometry.cameras import project
from poem_jax.geometry.distortion import fisheye_lens, stack_lenses
from poem_jax.hand.topology import ROOT_JOINT, WRIST
from poem_jax.models.config import CropConfig

HW = (64, 64)


@pytest.fixture
def frame(rig):
    """A hand's joints in three views, with key points, and white photographs."""
    joints = np.random.default_rng(0).uniform(-0.05, 0.05, (21, 3))
    uv = np.stack([project_raw(rig, view, joints)[0] for view in range(3)])
    boxes = np.concatenate([uv.min(1), uv.max(1)], -1)
    images = tuple(np.full((180, 240, 3), 255, np.uint8) for _ in range(3))
    return Frame("0", boxes[None], uv[None], images=images, hands=(HandResult(np.zeros(3, bool)),)), joints


def crops_of(frame, rig, ratio=1.5, upright=False):
    crop = CropConfig(ratio, upright)
    (done,) = crop_hands([frame._replace(squares_px=hand_squares(frame, rig))], rig, crop, HW)
    return done.crops[0]


@pytest.mark.parametrize("ratio", [1.0, 1.5, 2.0])
def test_a_crop_is_the_square_about_the_joints_times_the_ratio(frame, rig, ratio):
    frame, joints = frame
    crops = crops_of(frame, rig, ratio)
    for view in range(3):
        uv, _ = project(crops.K[view].astype(float), crops.T_cam_from_world[view].astype(float), joints)
        low, high = uv.min(0), uv.max(0)
        assert (high - low).max() == pytest.approx(64 / ratio, abs=0.02)
        np.testing.assert_allclose((low + high) / 2, 32, atol=0.02)


def test_upright_crops_show_the_knuckle_above_the_wrist(frame, rig):
    frame, joints = frame
    crops = crops_of(frame, rig, 1.5, upright=True)
    level = crops_of(frame, rig, 1.5)
    assert crops.view_mask.all()
    for view in range(3):
        T = crops.T_cam_from_world[view].astype(float)
        uv, depth = project(crops.K[view].astype(float), T, joints)
        up = uv[ROOT_JOINT] - uv[WRIST]
        assert up[1] < 0
        assert abs(up[0]) < 3e-3 * -up[1]
        assert np.ptp(uv, axis=0).max() == pytest.approx(64 / 1.5, abs=0.02)
        np.testing.assert_allclose((uv.min(0) + uv.max(0)) / 2, 32, atol=0.02)
        before = project(level.K[view].astype(float), level.T_cam_from_world[view].astype(float), joints)[1]
        np.testing.assert_allclose(depth, before, atol=1e-6)


def test_upright_pictures_turn_with_their_cameras(frame, rig):
    """Every joint in turn is a bright spot in the photograph, and lies where the crop's camera sees it."""
    frame, joints = frame
    for joint in (WRIST, ROOT_JOINT, 20):
        images = []
        for view in range(3):
            image = np.zeros((180, 240, 3), np.uint8)
            at = np.round(frame.keypoints_px[0, view, joint] * 16 - 8).astype(int)
            images.append(cv2.circle(image, at.tolist(), 5 * 16, (255,) * 3, -1, cv2.LINE_AA, 4))
        crops = crops_of(frame._replace(images=tuple(images)), rig, 2.0, upright=True)
        for view in range(3):
            grey = crops.views[view, ..., 0].astype(float)
            rows, columns = np.mgrid[:64, :64] + 0.5
            middle = np.array([(grey * columns).sum(), (grey * rows).sum()]) / grey.sum()
            T = crops.T_cam_from_world[view].astype(float)
            expected = project(crops.K[view].astype(float), T, joints[joint : joint + 1])[0][0]
            np.testing.assert_allclose(middle, expected, atol=0.4)


def test_a_view_that_does_not_see_the_palm_has_no_upright_crop(frame, rig):
    frame, _ = frame
    keypoints = frame.keypoints_px.copy()
    keypoints[0, 1, WRIST] = np.nan
    crops = crops_of(frame._replace(keypoints_px=keypoints), rig, upright=True)
    assert crops.view_mask.tolist() == [True, False, True]


def test_boxes_alone_do_not_tell_which_way_is_up(frame, rig):
    frame, _ = frame
    with pytest.raises(ValueError, match="trained on upright hands"):
        crops_of(frame._replace(keypoints_px=None), rig, upright=True)


def test_a_view_without_box_or_image_is_masked(frame, rig):
    frame, _ = frame
    boxes, keypoints = frame.boxes_px.copy(), frame.keypoints_px.copy()
    boxes[0, 1] = keypoints[0, 1] = np.nan
    images = (None, *frame.images[1:])
    crops = crops_of(frame._replace(boxes_px=boxes, keypoints_px=keypoints, images=images), rig)
    assert crops.view_mask.tolist() == [False, False, True]
    assert not crops.views[:2].any()
    np.testing.assert_array_equal(crops.K[0], np.eye(3))
    assert crops.views.dtype == np.uint8
    assert crops.K.dtype == np.float32


def test_a_hand_with_a_reason_against_it_is_not_cut(frame, rig):
    frame, _ = frame
    assert crops_of(frame._replace(hands=(HandResult(np.zeros(3, bool), "wrong box"),)), rig) is None


def test_boxes_alone_are_followed_through_the_lens(frame, rig):
    """Of a box only the outline is known, so the square is at least as large as that of the joints."""
    frame, _ = frame
    by_points = hand_squares(frame, rig)[0]
    by_box = hand_squares(frame._replace(keypoints_px=None), rig)[0]
    sides = [squares[:, 2] - squares[:, 0] for squares in (by_points, by_box)]
    assert (sides[1] >= sides[0] - 0.5).all()
    np.testing.assert_allclose(by_box, by_points, atol=8)


def test_what_lies_beyond_the_photograph_is_black(frame, rig):
    frame, _ = frame
    aside = np.array([-20.0, 60, 60, 140])
    boxes = np.where(np.arange(3)[:, None] == 2, aside, frame.boxes_px[0])
    crops = crops_of(frame._replace(boxes_px=boxes[None], keypoints_px=None), rig)
    grey = cv2.cvtColor(crops.views[2], cv2.COLOR_RGB2GRAY)
    assert not grey[:, :8].any()
    assert (grey[:, -8:] == 255).all()


def test_a_view_with_too_few_key_points_falls_back_on_its_box(frame, rig):
    frame, _ = frame
    keypoints = frame.keypoints_px.copy()
    keypoints[0, 1, 4:] = np.nan
    few = hand_squares(frame._replace(keypoints_px=keypoints), rig)
    by_box = hand_squares(frame._replace(keypoints_px=None), rig)
    np.testing.assert_array_equal(few[0, 1], by_box[0, 1])


def test_a_hand_that_a_fisheye_sees_far_aside_counts_as_unseen_and_is_said(frame, rig):
    """No flat picture shows what lies more than 85 degrees off the axis, though the image has it."""
    frame, _ = frame
    fisheye = fisheye_lens(np.zeros(4))
    rig = rig._replace(dist=stack_lenses([*rig.dist[:2], fisheye]))
    aside = np.radians([83.0, 92.0])
    for angle, seen in zip(aside, (True, False), strict=True):
        centre = rig.K[2, :2, 2] + [rig.K[2, 0, 0] * angle, 0]
        keypoints = frame.keypoints_px.copy()
        keypoints[0, 2] = centre + np.random.default_rng(0).uniform(-4, 4, (21, 2))
        boxes = np.concatenate([keypoints.min(2), keypoints.max(2)], -1)
        there = frame._replace(keypoints_px=keypoints, boxes_px=boxes)
        squares = hand_squares(there, rig)
        np.testing.assert_array_equal(np.isfinite(squares[0]).all(-1), [True, True, seen])
        if not seen:
            (judged,) = judge_boxes([there], rig)
            assert judged.warnings == (
                "camera 'cam 3': 1 hands lie where its fisheye looks more than 85 degrees aside, which no "
                "flat picture shows: they count as unseen",
            )
            assert judged.hands[0].reason is None
