"""Boxes and key points: round trip, half a pixel, frames matched by name, what is said of wrong files."""

import unicodedata
from pathlib import Path

import numpy as np
import pytest

from poem_jax.capture.boxes_file import (
    MIN_CONFIDENCE,
    HandBoxes,
    align_boxes,
    boxes_from_keypoints,
    read_boxes,
    without_boxes_outside,
    write_boxes,
)


@pytest.fixture
def keypoints():
    uv = np.random.default_rng(0).uniform(10, 90, (3, 2, 4, 21, 2))
    uv[1, 0, 2] = np.nan
    uv[1, 0, 3, 4:] = np.nan
    return uv


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_round_trip(tmp_path, keypoints):
    hands = HandBoxes(boxes_from_keypoints(keypoints), ("left", "right"), ("a", "b", "c"), keypoints)
    back = read_boxes(write_boxes(tmp_path / "boxes.npz", hands))
    assert back.hand_side == hands.hand_side
    assert back.frames == hands.frames
    np.testing.assert_array_equal(back.boxes_px, hands.boxes_px)
    np.testing.assert_allclose(back.keypoints_px, keypoints, atol=1e-12)


def test_keypoints_move_by_half_a_pixel_and_make_boxes(tmp_path, keypoints):
    hands = read_boxes(save(tmp_path / "k.npz", keypoints_px=keypoints, hand_side=["right", "left"]))
    np.testing.assert_allclose(hands.keypoints_px, keypoints + 0.5)
    seen = hands.boxes_px[0, 1, 2]
    np.testing.assert_allclose(seen, [*(keypoints[0, 1, 2].min(0) + 0.5), *(keypoints[0, 1, 2].max(0) + 0.5)])
    assert np.isnan(hands.boxes_px[1, 0, 2:]).all()  # unseen, and too few points


def test_key_points_that_their_detector_does_not_trust_are_dropped(tmp_path, keypoints):
    confidence = np.ones(keypoints.shape[:-1])
    confidence[0, 0, 0, :4] = 0, np.nan, MIN_CONFIDENCE / 2, MIN_CONFIDENCE
    confidence[0, 1] = 0
    content = {"keypoints_px": keypoints, "hand_side": ["right", "left"]}
    hands = read_boxes(save(tmp_path / "k.npz", confidence=confidence, **content))
    assert np.isnan(hands.keypoints_px[0, 0, 0, :3]).all()
    np.testing.assert_allclose(hands.keypoints_px[0, 0, 0, 3:], keypoints[0, 0, 0, 3:] + 0.5)
    low = keypoints[0, 0, 0, 3:].min(0) + 0.5
    np.testing.assert_allclose(hands.boxes_px[0, 0, 0, :2], low)
    assert np.isnan(hands.boxes_px[0, 1]).all()
    for wrong, message in (
        (-confidence, "must be from 0 to 1"),
        (confidence[..., :20], r"one per key point"),
    ):
        with pytest.raises(ValueError, match=f"`confidence` .*{message}"):
            read_boxes(save(tmp_path / "k.npz", confidence=wrong, **content))


def test_key_points_written_as_zero_are_unseen(tmp_path, keypoints, caplog):
    seen = keypoints[0, 0, 0, 3:] + 0.5
    keypoints[0, 0, 0, :3] = 0
    keypoints[0, 1, 0] = 0
    keypoints[0, 1, 1] = 7
    hands = read_boxes(save(tmp_path / "k.npz", keypoints_px=keypoints, hand_side=["right", "left"]))
    np.testing.assert_allclose(hands.boxes_px[0, 0, 0], [*seen.min(0), *seen.max(0)])
    assert np.isnan(hands.boxes_px[0, 1, :2]).all()  # all zero; all at one place
    assert "24 key points at exactly (0, 0) or (-1, -1) count as unseen" in caplog.text


def test_key_points_and_boxes_written_as_minus_one_are_unseen(tmp_path, keypoints, caplog):
    keypoints[0, 0, 0, :3] = -1
    boxes = np.tile([10.0, 10, 90, 90], (3, 2, 4, 1))
    boxes[0, 0, 1], boxes[0, 0, 2] = -1, 0
    content = {"keypoints_px": keypoints, "boxes_px": boxes, "hand_side": ["right", "left"]}
    hands = read_boxes(save(tmp_path / "k.npz", **content))
    assert np.isnan(hands.keypoints_px[0, 0, 0]).all(-1).tolist() == [True] * 3 + [False] * 18
    assert np.isfinite(hands.boxes_px[0, 0]).all(-1).tolist() == [True, False, False, True]
    assert "3 key points at exactly (0, 0) or (-1, -1)" in caplog.text
    assert "2 boxes of which all numbers are 0 or -1" in caplog.text


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (lambda p: 100 * p, "divide percent by 100"),
        (lambda p: np.log(p / (1 - p)), "they look like logits: apply a sigmoid"),
        (lambda p: np.log(p), "apply a sigmoid, or write NaN"),
        (lambda p: np.where(p > 0.5, -1, p), "or write NaN"),
        (lambda p: np.where(p > 0.5, np.inf, p), "got .* to inf; write NaN"),
    ],
)
def test_confidences_on_another_scale_are_refused(tmp_path, keypoints, scale, message):
    probability = np.random.default_rng(1).uniform(0.05, 0.99, keypoints.shape[:-1])
    content = {"keypoints_px": keypoints, "hand_side": ["right", "left"]}
    read_boxes(save(tmp_path / "k.npz", confidence=1.05 * probability, **content))
    with pytest.raises(ValueError, match=f"`confidence` must be from 0 to 1, .*{message}"):
        read_boxes(save(tmp_path / "k.npz", confidence=scale(probability), **content))


def test_views_are_matched_by_name(tmp_path, keypoints):
    """A file whose cameras stand in another order than the rig's gives the same hands."""
    content = {"hand_side": ["right", "left"]}
    names = ("a", "b", "c", "höhe")
    straight = read_boxes(save(tmp_path / "k.npz", keypoints_px=keypoints, **content))
    straight = align_boxes(straight, ("0", "1", "2"), names, "k.npz")
    order = [2, 0, 3, 1]
    turned = {
        "keypoints_px": keypoints[:, :, order],
        "cameras": [unicodedata.normalize("NFD", names[i]) for i in order],
    }
    turned = align_boxes(
        read_boxes(save(tmp_path / "k.npz", **turned, **content)), ("0", "1", "2"), names, "k.npz"
    )
    assert turned.cameras == straight.cameras == names
    np.testing.assert_array_equal(turned.keypoints_px, straight.keypoints_px)
    np.testing.assert_array_equal(turned.boxes_px, straight.boxes_px)
    fewer = {"keypoints_px": keypoints[:, :, [2, 0]], "cameras": ["c", "a"]}
    fewer = align_boxes(
        read_boxes(save(tmp_path / "k.npz", **fewer, **content)), ("0", "1", "2"), names, "k.npz"
    )
    np.testing.assert_array_equal(fewer.keypoints_px[:, :, [0, 2]], straight.keypoints_px[:, :, [0, 2]])
    assert np.isnan(fewer.keypoints_px[:, :, [1, 3]]).all()
    with pytest.raises(ValueError, match=r"k\.npz: its `cameras` must be among the rig's \(a, b\); got c"):
        align_boxes(fewer._replace(cameras=("a", "c")), ("0", "1", "2"), ("a", "b"), "k.npz")
    again = read_boxes(write_boxes(tmp_path / "again.npz", turned))
    assert again.cameras == names


@pytest.mark.parametrize("frames", [[3, 12], [3.0, 12.0], ["3", "12"], [b"3", b"12"]])
def test_frames_as_numbers_or_text(tmp_path, keypoints, frames):
    content = {"keypoints_px": keypoints[:2], "frames": frames, "hand_side": [b"right", b"Left"]}
    hands = read_boxes(save(tmp_path / "k.npz", **content))
    assert hands.frames == ("3", "12")
    assert hands.hand_side == ("right", "left")


def test_boxes_outside_their_image_are_unseen(caplog):
    size_wh = np.array([[100, 80]] * 4)
    boxes = np.array([[-20.0, 5, 0, 30], [5, 80, 20, 90], [-20, -20, 1, 1], [99, 79, 150, 150]])
    hands = HandBoxes(boxes[None, None], ("left",), ("7",))
    kept = without_boxes_outside(hands, size_wh).boxes_px[0, 0]
    assert np.isfinite(kept).all(-1).tolist() == [False, False, True, True]
    assert "2 boxes lie wholly outside their images" in caplog.text
    assert "frame 7, hand 0, view 0: [-20.0, 5.0, 0.0, 30.0]" in caplog.text


def test_any_file_name_will_do(tmp_path, keypoints):
    hands = HandBoxes(boxes_from_keypoints(keypoints), ("left", "right"))
    path = write_boxes(tmp_path / "boxes", hands)
    assert [path] == list(tmp_path.iterdir())
    np.testing.assert_array_equal(read_boxes(path).boxes_px, hands.boxes_px)


def test_frames_are_matched_by_name_or_number(keypoints):
    boxes = boxes_from_keypoints(keypoints)
    hands = HandBoxes(boxes, ("left", "right"), ("9", "12", "30"))
    aligned = align_boxes(hands, ("0030", "0009", "0010"), "abcd", "b.npz")
    np.testing.assert_array_equal(aligned.boxes_px[0], boxes[2])
    np.testing.assert_array_equal(aligned.boxes_px[1], boxes[0])
    assert np.isnan(aligned.boxes_px[2]).all()
    unnamed = align_boxes(hands._replace(frames=None), ("x", "y", "z"), "abcd", "b.npz")
    assert unnamed.frames == ("x", "y", "z")
    one = HandBoxes(boxes[:1], ("left", "right"), ("9",))
    assert align_boxes(one, ("0000",), "abcd", "b.npz").frames == ("0000",)
    with pytest.raises(ValueError, match=r"the rig has 3 views; the boxes have 4"):
        align_boxes(hands, ("9",), "abc", "b.npz")
    with pytest.raises(ValueError, match=r"the capture has 2 frames, the boxes 3; add `frames"):
        align_boxes(hands._replace(frames=None), ("x", "y"), "abcd", "b.npz")
    with pytest.raises(ValueError, match=r"no frame of the capture \(7, \.\.\.\) is among its `frames`"):
        align_boxes(hands, ("7",), "abcd", "b.npz")


GOOD = {"boxes_px": np.array([[[[1.0, 2, 3, 4]]]]), "hand_side": ["right"]}
BAD = {
    "sides missing": ({"hand_side": None}, r"`hand_side \(H,\)` is missing"),
    "unknown side": ({"hand_side": ["both"]}, "must hold 'left' or 'right'; got 'both'"),
    "nothing": ({"boxes_px": None}, "must hold `boxes_px` or `keypoints_px`; found hand_side"),
    "shape": (
        {"boxes_px": np.zeros((2, 4))},
        r"`boxes_px` must be numbers of shape \(frames, 1 hands, views, 4\)",
    ),
    "hands": (
        {"hand_side": ["left", "right"]},
        r"shape \(frames, 2 hands, views, 4\); got float64 \(1, 1, 1, 4\)",
    ),
    "empty box": (
        {"boxes_px": np.array([[[[3.0, 2, 1, 4]]]])},
        r"x0 < x1 .* got \[3.0, 2.0, 1.0, 4.0\] \(frame 0",
    ),
    "frames": ({"frames": ["a", "b"]}, "`frames` must name 1 frames; got 2"),
    "frames twice": (
        {"boxes_px": np.tile(GOOD["boxes_px"], (2, 1, 1, 1)), "frames": ["9", "09"]},
        "`frames` must differ from each other, also as numbers",
    ),
    "frames are paths": ({"frames": ["/take/000001"]}, "`frames`.* which is a path"),
    "frames lead out": ({"frames": ["../x"]}, "`frames`.* which is a path"),
    "frames without a name": ({"frames": [""]}, "`frames`.* which is empty"),
    "cameras twice": (
        {"boxes_px": np.tile(GOOD["boxes_px"], (1, 1, 2, 1)), "cameras": ["a", "a"]},
        "`cameras` must differ from each other; 'a' is both number 0 and 1",
    ),
    "cameras too many": ({"cameras": ["a", "b"]}, "`cameras` must name 1 views; got 2"),
    "complex": ({"boxes_px": GOOD["boxes_px"] + 1j}, "`boxes_px`: .* got complex numbers"),
    "truth values": ({"boxes_px": GOOD["boxes_px"] > 2}, "`boxes_px` must be numbers"),
    "x y w h": ({"boxes_px": np.array([[[[30.0, 20, 5, 6]]]])}, r"not x y width height\); got \[30"),
    "scores in the third column": (
        {"keypoints_px": np.zeros((1, 1, 1, 21, 3))},
        "the third number, if it is a score, as `confidence`",
    ),
    "views before hands": (
        {"boxes_px": np.ones((2, 4, 1, 4))},
        r"got float64 \(2, 4, 1, 4\); views and hands are exchanged",
    ),
    "disagree": ({"keypoints_px": np.zeros((1, 1, 2, 21, 2))}, "must agree in frames, hands and views"),
    "pickle": ({"boxes_px": np.array([{"a": 1}], dtype=object)}, "must be an npz of plain arrays"),
}


@pytest.mark.parametrize("case", BAD)
def test_wrong_content_is_named(tmp_path, case):
    change, message = BAD[case]
    content = {name: value for name, value in {**GOOD, **change}.items() if value is not None}
    with pytest.raises(ValueError, match=message):
        read_boxes(save(tmp_path / "b.npz", **content))


def test_the_example_of_the_docs(tmp_path, monkeypatch):
    text = (Path(__file__).resolve().parents[2] / "docs" / "captures.md").read_text()
    example = next(block for block in text.split("```python")[1:] if "np.savez" in block).split("```")[0]
    (tmp_path / "my_capture").mkdir()
    monkeypatch.chdir(tmp_path)
    exec(example, {})
    hands = read_boxes("my_capture/boxes.npz")
    assert np.isfinite(hands.boxes_px).all(-1)[0, 0].tolist() == [True, False, True, False]


def test_wrong_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no boxes file at .*; say where the hands are"):
        read_boxes(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("boxes")
    with pytest.raises(ValueError, match="must be an npz of plain arrays"):
        read_boxes(tmp_path / "text.npz")
    whole = save(tmp_path / "whole.npz", **GOOD).read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="must be an npz of plain arrays"):
        read_boxes(tmp_path / "half.npz")


@pytest.mark.parametrize(("confidence", "told"), [(0.1, True), (0.9, False)])
def test_low_confidences_that_cost_most_key_points_are_told(tmp_path, caplog, confidence, told):
    points = np.arange(2 * 3 * 21 * 2.0).reshape(2, 1, 3, 21, 2)
    weights = np.full(points.shape[:-1], confidence)
    np.savez(tmp_path / "k.npz", keypoints_px=points, hand_side=["right"], confidence=weights)
    read_boxes(tmp_path / "k.npz")
    assert ("of 126 key points have a confidence below 0.2" in caplog.text) == told
