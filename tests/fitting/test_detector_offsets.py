"""Where a detector sees the key points: derivatives, left hands, fits that allow for it, files, warnings."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import poem_jax.capture.fit
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints, read_boxes, write_boxes
from poem_jax.capture.fit import fit_hands
from poem_jax.capture.frame import HandResult
from poem_jax.capture.judge import judge_hands
from poem_jax.capture.take import Take, make_take
from poem_jax.data.capture_folder import FramePaths
from poem_jax.data.lens import project_raw
from poem_jax.fitting.detector_offsets import (
    DETECTORS,
    MEDIAPIPE_HANDS,
    KeypointOffsets,
    keypoint_axes,
    offsets_of,
    rest_offsets,
)
from poem_jax.fitting.kinematics import (
    joints_of,
    keypoint_model,
    pose_jacobian,
    pose_keypoints,
    shape_jacobian,
)
from poem_jax.fitting.take import fit_take
from poem_jax.geometry.cameras import project
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import axis_angle_from_rotation, rotation_from_axis_angle
from poem_jax.hand.model import mirror_pose
from poem_jax.hand.pair import hands_of
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import FINGER_JOINTS, INDEX_KNUCKLE, LITTLE_KNUCKLE
from poem_jax.synthetic.keypoint_takes import IMAGE_WH, draw_keypoint_take
from tests.fitting.conftest import as_float64
from tests.fitting.observed import observed

FRAMES, VIEWS = 8, 4
TIPS = [finger[-1] for finger in FINGER_JOINTS]
MIDDLE_TIP = TIPS[2]
PLANTED = KeypointOffsets(1e-3 * np.random.default_rng(0).normal(0, 6, (21, 3)))
"""Everywhere, the wrist too."""
NOTHING = KeypointOffsets(np.zeros((21, 3)))
"""Runs the same program as PLANTED, where None has one of its own."""


def as_seen(take, side, offsets):
    """The take's exact key points as a detector with these habits sees them."""
    model = keypoint_model(default_hand(side), offsets)
    posed = pose_keypoints(model, take.pose, take.shape)
    points = np.asarray(posed.points - joints_of(model, posed)) + take.joints
    uv, _ = project(take.K[None], take.T_cam_from_world[None], points[:, None].astype(np.float64))
    return take._replace(uv_px=np.asarray(uv, np.float32)), points


@pytest.fixture(scope="module")
def fitted():
    """Fits of what a detector with the planted habits sees: told of them, and not."""
    truth = draw_keypoint_take(default_hand(), FRAMES, VIEWS, 0.0, 3)
    take, points = as_seen(truth, "right", PLANTED)
    told, untold = (
        jax.device_get(fit_take(keypoint_model(default_hand(), detector), observed(take)))
        for detector in (PLANTED, NOTHING)
    )
    return truth, points, told, untold


def test_key_points_are_moved_along_the_bones_that_carry_them():
    hand = default_hand()
    model = keypoint_model(hand, KeypointOffsets(np.tile([0.01, 0, 0], (21, 1))))
    rest = np.asarray(model.points)
    for finger in FINGER_JOINTS:
        for start, end in zip((0, *finger[:-1]), finger, strict=True):
            bone = rest[end] - rest[start]
            np.testing.assert_allclose(model.offsets[end], 0.01 * bone / np.linalg.norm(bone), atol=1e-6)
    axes = keypoint_axes(hand)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (21, 1, 1)), atol=1e-6)
    across = rest[INDEX_KNUCKLE] - rest[LITTLE_KNUCKLE]
    assert (axes[5:, 2] @ across > 0).all()  # towards the thumb
    assert (axes[5:, 1, 1] > 0.9).all()  # the back of a resting hand is up


def test_left_hands_are_mirrored():
    right, left = (keypoint_model(default_hand(side), PLANTED) for side in ("right", "left"))
    np.testing.assert_allclose(left.offsets, right.offsets * np.array([-1, 1, 1]), atol=1e-7)
    pose, shape = np.float32(0.4 * np.random.default_rng(1).normal(size=(16, 3))), np.zeros(10, np.float32)
    seen = pose_keypoints(right, pose, shape).points
    mirrored = pose_keypoints(left, mirror_pose(pose), shape).points
    same = np.arange(21) != MIDDLE_TIP  # a left hand has its neighbour, as MANO's layer does
    np.testing.assert_allclose(mirrored[same], (seen * np.array([-1, 1, 1]))[same], atol=1e-6)
    with pytest.raises(ValueError, match="axes are those of a right hand"):
        keypoint_axes(default_hand("left"))


def test_a_fit_that_knows_the_detector_finds_the_hands_own_joints(fitted):
    truth, points, told, untold = fitted
    error = 1e3 * np.linalg.norm(told.joints - truth.joints, axis=-1)
    assert told.valid.all()
    assert np.median(error) < 0.5
    assert error.max() < 3
    np.testing.assert_allclose(told.keypoints, points, atol=3e-3)
    assert told.reprojection_px.max() < 1
    # Not told, it follows the key points instead of the joints.
    missed = 1e3 * np.linalg.norm(untold.joints - truth.joints, axis=-1)
    assert 3 < np.median(missed) < 15
    followed = 1e3 * np.linalg.norm(untold.joints - points, axis=-1)
    assert np.median(followed) < np.median(missed)
    np.testing.assert_allclose(untold.keypoints, untold.joints, atol=1e-6)


def test_without_a_detector_nothing_changes():
    model = keypoint_model(default_hand())
    assert model.offsets is None
    assert keypoint_model(default_hand(), offsets_of("none")).offsets is None
    zero = keypoint_model(default_hand(), NOTHING)
    pose, shape = np.full((16, 3), 0.1, np.float32), np.ones(10, np.float32)
    plain, moved = (pose_keypoints(one, pose, shape) for one in (model, zero))
    np.testing.assert_array_equal(plain.points, moved.points)
    assert joints_of(model, plain) is plain.points


def test_uncertainty_is_that_of_the_joints(fitted):
    """Moving what is observed by millimetres hardly moves how well the joints are known."""
    _, _, told, _ = fitted
    assert (told.sigma_m > 0).all()
    assert told.sigma_m.max() < 0.01


def test_shipped_calibration():
    offsets = DETECTORS[MEDIAPIPE_HANDS].offsets_m
    assert offsets.shape == (21, 3)
    assert ((offsets[TIPS, 0] < -0.004) & (offsets[TIPS, 0] > -0.01)).all()  # short of the skin's end
    assert np.abs(offsets).max() < 0.01
    moved = np.linalg.norm(rest_offsets(default_hand("left"), DETECTORS[MEDIAPIPE_HANDS]), axis=-1)
    np.testing.assert_allclose(moved, np.linalg.norm(offsets, axis=-1), atol=1e-7)


def test_an_unknown_detector_is_told(caplog):
    with caplog.at_level(logging.WARNING):
        assert offsets_of("another") is None
    assert "no calibration is known for the detector 'another' (known: mediapipe-hands)" in caplog.text
    caplog.clear()
    assert offsets_of(None) is offsets_of("none") is None
    assert offsets_of(MEDIAPIPE_HANDS) is DETECTORS[MEDIAPIPE_HANDS]
    assert not caplog.text


def test_files_name_their_detector(tmp_path):
    keypoints = np.random.default_rng(0).uniform(10, 90, (2, 1, 3, 21, 2))
    hands = HandBoxes(boxes_from_keypoints(keypoints), ("right",), None, keypoints)
    for name in (MEDIAPIPE_HANDS, "another", None):
        path = write_boxes(tmp_path / "keypoints.npz", hands._replace(detector=name))
        assert read_boxes(path).detector == name
    with np.load(path) as content:
        assert "detector" not in content
        np.savez(path, **content, detector=["a", "b"])
    with pytest.raises(ValueError, match="`detector` must be one name; got 2"):
        read_boxes(path)


@pytest.fixture(scope="module")
def capture() -> Take:
    """What the shipped detector sees of a take, as its file says."""
    truth = draw_keypoint_take(default_hand(), FRAMES, VIEWS, 0.0, 5)
    take, _ = as_seen(truth, "right", DETECTORS[MEDIAPIPE_HANDS])
    names = tuple(f"cam_{view}" for view in range(VIEWS))
    K, T = take.K.astype(np.float64), take.T_cam_from_world.astype(np.float64)
    rig = Rig(names, np.tile(IMAGE_WH, (VIEWS, 1)), K, np.zeros((VIEWS, 5)), T)
    uv = take.uv_px[:, None].astype(np.float64)
    frames = [FramePaths(f"{frame:04d}", (None,) * VIEWS) for frame in range(FRAMES)]
    hands = HandBoxes(boxes_from_keypoints(uv), ("right",), None, uv, detector=MEDIAPIPE_HANDS)
    return make_take(rig, frames, hands)


def reprojection_px(take: Take, **options) -> float:
    frames = list(judge_hands(fit_hands(take.frames, take, hands_of(default_hand()), **options), take.rig))
    return float(np.median([frame.hands[0].reprojection_px for frame in frames]))


class Chosen(Exception):
    """Ends a fit before it begins."""


def test_the_file_names_the_detector_unless_told_otherwise(capture, monkeypatch):
    def choose(hands, side, offsets):
        raise Chosen(offsets)

    monkeypatch.setattr(poem_jax.capture.fit, "_keypoint_models", choose)
    known = DETECTORS[MEDIAPIPE_HANDS]
    for named, told, expected in (
        (MEDIAPIPE_HANDS, None, known),
        (MEDIAPIPE_HANDS, "none", None),
        (None, None, None),
        (None, MEDIAPIPE_HANDS, known),
        ("another", None, None),
    ):
        take = capture._replace(detector=named)
        with pytest.raises(Chosen) as chosen:
            next(fit_hands(take.frames, take, hands_of(default_hand()), detector=told))
        assert chosen.value.args == (expected,)


def test_what_is_judged_is_where_the_detector_should_see_the_joints(capture):
    frame = next(iter(capture.frames))
    joints = np.random.default_rng(0).uniform(-0.05, 0.05, (21, 3))
    uv = np.stack([project_raw(capture.rig, view, joints)[0] for view in range(VIEWS)])
    hand = HandResult(np.ones(VIEWS, bool), joints_world=joints + 0.01, expected_world=joints)
    for expected, low, high in ((joints, 0, 1e-6), (None, 5, 50)):
        hand = hand._replace(expected_world=expected)
        (judged,) = judge_hands([frame._replace(keypoints_px=uv[None], hands=(hand,))], capture.rig)
        assert low <= judged.hands[0].reprojection_px.mean() <= high


@pytest.mark.slow
def test_a_capture_is_fitted_as_its_file_says(capture, caplog):
    assert capture.detector == MEDIAPIPE_HANDS
    known = reprojection_px(capture)
    assert known < 0.5
    assert reprojection_px(capture._replace(detector=None), detector=MEDIAPIPE_HANDS) == known
    plain = reprojection_px(capture, detector="none")
    assert plain > 2 * known
    with caplog.at_level(logging.WARNING):
        assert reprojection_px(capture._replace(detector="another")) == plain
    assert "no calibration is known for the detector 'another'" in caplog.text


def test_derivatives_are_those_of_the_moved_points(float64):
    # The last one: what is traced in float64 stays in caches.
    model = keypoint_model(as_float64(default_hand()), PLANTED)
    rng = np.random.default_rng(2)
    pose, shape = jnp.asarray(0.6 * rng.normal(size=(16, 3))), jnp.asarray(rng.normal(size=10))
    pose_them = jax.jit(pose_keypoints)
    posed, bare = (pose_them(one, pose, shape) for one in (model, model._replace(offsets=None)))
    np.testing.assert_allclose(joints_of(model, posed), bare.points, atol=1e-12)
    moved = np.linalg.norm(posed.points - bare.points, axis=-1)
    rigid = [joint for joint in range(21) if joint not in TIPS]
    np.testing.assert_allclose(moved[rigid], np.linalg.norm(model.offsets, axis=-1)[rigid], atol=1e-9)

    def points(x):
        first = rotation_from_axis_angle(x[:3]) @ rotation_from_axis_angle(pose[0])
        turned = jnp.concatenate([axis_angle_from_rotation(first)[None], pose[1:] + x[3:48].reshape(15, 3)])
        return pose_keypoints(model, turned, shape + x[48:]).points

    step = 1e-6
    at = jax.jit(jax.vmap(points))
    differences = (at(step * jnp.eye(58)) - at(-step * jnp.eye(58))) / (2 * step)
    turned, reshaped = jax.jit(pose_jacobian)(model, posed, pose), jax.jit(shape_jacobian)(model, posed)
    expected = jnp.concatenate([turned, reshaped], axis=-1)
    np.testing.assert_allclose(expected, jnp.moveaxis(differences, 0, -1), atol=1e-8)
