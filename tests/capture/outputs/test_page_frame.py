"""What the page is told of a frame."""

import cv2
import numpy as np
import pytest

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.outputs.page import make_gallery, picture_sides
from poem_jax.capture.outputs.page_frame import joint_errors_px, page_facts, page_frame
from poem_jax.capture.report import Report
from poem_jax.capture.take import Take
from poem_jax.data.lens import project_raw
from poem_jax.geometry.cameras import project
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.viz.page import PageFrame, PageHand

LOST = HandResult(np.zeros(3, bool), "seen in no view")


def joints(seed=0):
    return np.random.default_rng(seed).uniform(-0.08, 0.08, (21, 3))


def seen_by(rig, points_world):
    return np.stack([project_raw(rig, view, points_world)[0] for view in range(rig.num_views)])


def found(points_world, **more):
    return HandResult(np.ones(3, bool), vertices_world=np.zeros((778, 3)), joints_world=points_world, **more)


def made(rig, frame):
    take = Take(rig, ("right", "left"), ())
    gallery = make_gallery(rig, 1)
    return page_frame(frame, take, *gallery), gallery


def frame_of(rig, right, **more):
    images = tuple(np.full((180, 240, 3), 90, np.uint8) for _ in range(3))
    return Frame("a", np.zeros((2, 3, 4)), hands=(right, LOST), images=images, **more)


def test_key_points_lie_where_the_pages_own_cameras_see_the_joints(rig):
    """From the distorted photograph to a picture of another pinhole, which looks another way."""
    seen = np.full((2, 3, 21, 2), np.nan)
    seen[0] = seen_by(rig, joints())
    seen[0, 1, 4] = np.nan
    page, gallery = made(rig, frame_of(rig, found(joints()), keypoints_px=seen, time_s=1.5))
    assert page.time_s == 1.5
    assert list(page.hands) == ["right"]
    for view, camera in enumerate(gallery.cameras):
        height, width = camera.hw
        K = np.array([[camera.focal_px, 0, width / 2], [0, camera.focal_px, height / 2], [0, 0, 1]])
        expected = project(K, camera.T_cam_from_world, joints())[0]
        expected[[4] if view == 1 else []] = np.nan
        np.testing.assert_allclose(page.hands["right"].keypoints_px[view], expected, atol=1e-3)
    errors = page.hands["right"].error_px
    assert np.isnan(errors[1, 4])
    np.testing.assert_allclose(np.delete(errors, 4, axis=1), 0, atol=1e-6)


def test_errors_are_those_of_what_the_detector_should_see(rig):
    seen = seen_by(rig, joints()) + np.array([3.0, 4.0])
    np.testing.assert_allclose(joint_errors_px(joints(), seen, rig), 5.0)
    both = np.stack([seen, seen])
    page, _ = made(rig, frame_of(rig, found(joints(1), expected_world=joints()), keypoints_px=both))
    np.testing.assert_allclose(page.hands["right"].error_px, 5.0)
    np.testing.assert_array_equal(page.hands["right"].joints_world, joints())


def test_a_bridged_hand_has_no_errors(rig):
    """One view may have seen it, which is too few to find it."""
    seen = np.stack([seen_by(rig, joints())] * 2)
    page, _ = made(rig, frame_of(rig, found(joints(), bridged=True), keypoints_px=seen))
    assert page.hands["right"].error_px is None
    assert page.hands["right"].keypoints_px is None


def test_a_network_that_sees_the_root_alone(rig):
    roots = seen_by(rig, joints())[:, [ROOT_JOINT]]
    page, _ = made(rig, frame_of(rig, found(joints(), keypoints_px=roots)))
    errors = page.hands["right"].error_px
    np.testing.assert_allclose(errors[:, ROOT_JOINT], 0, atol=1e-6)
    assert np.isnan(np.delete(errors, ROOT_JOINT, axis=1)).all()
    nothing, _ = made(rig, frame_of(rig, found(joints())))
    assert nothing.hands["right"].keypoints_px is None


def test_what_is_known_of_a_hand_is_handed_on(rig):
    known = {"joint_sigma_m": np.full(21, 0.002), "joint_confidence": np.full((3, 21), 0.5)}
    frame = frame_of(rig, found(joints(), bridged=True, **known))
    frame = frame._replace(images=(None, *frame.images[1:]))
    page, gallery = made(rig, frame)
    hand = page.hands["right"]
    assert hand.bridged
    assert hand.sigma_m is known["joint_sigma_m"]
    assert hand.confidence is known["joint_confidence"]
    assert page.pictures[0] is None
    picture = cv2.imdecode(np.frombuffer(page.pictures[2], np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[:2] == gallery.cameras[2].hw
    np.testing.assert_allclose(picture[picture.shape[0] // 2, picture.shape[1] // 2], 90, atol=2)


def test_facts(rig, tmp_path):
    report = Report(tmp_path / "report.json", Take(rig, ("right", "left"), ()))
    shown = {"reprojection_px": np.array([1.0, 2.0, 6.0]), "joints_shown": np.ones(3)}
    report.add(frame_of(rig, found(joints(), **shown), keypoints_px=np.zeros((2, 3, 21, 2))))
    sigma = np.full(21, 0.0031)
    page = PageFrame("a", {"right": PageHand(np.zeros((778, 3)), sigma_m=sigma)}, [None] * 3)
    assert page_facts(report, [page]) == {
        "frames": "1",
        "hands solved": "1 of 2",
        "cameras": "3",
        "median reprojection": "2.0 px",
        "median sigma": "3.1 mm",
    }
    nothing = Report(tmp_path / "report.json", Take(rig, ("right",), ()))
    assert "median reprojection" not in page_facts(nothing, [])
    report.close()
    nothing.close()


def test_the_pictures_of_a_page_share_its_size(rig):
    large = rig._replace(size_wh=8 * rig.size_wh)
    longest = [picture_sides(large, number)[0] for number in (1, 40, 120, 5000, None)]
    assert longest[0] == 640
    for number, side in zip((40, 120), longest[1:3], strict=True):
        assert 3 * number * side**2 * 3 / 4 == pytest.approx(14e6, rel=0.02)
    assert longest[3] == longest[4] == longest[2]


def test_pictures_are_neither_enlarged_nor_too_small_to_look_at(rig):
    assert picture_sides(rig, 1) == [240] * 3
    many = rig._replace(size_wh=np.repeat(8 * rig.size_wh, 40, axis=0), names=("c",) * 120)
    assert picture_sides(many, None) == [160] * 120
