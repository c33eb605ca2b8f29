"""Boxes and key points: round trip, half a pixel, frames matched by name, what is said of wrong files."""

from pathlib import Path

import numpy as np
import pytest

from poem_jax.capture.boxes_file import (
    MIN_CONFIDENCE,
    HandBoxes,
    align_frames,
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
    for wrong, message in ((-confidence, "must be 0 or more"), (confidence[..., :20], r"one per key point")):
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
    assert "24 key points at exactly (0, 0) count as unseen" in caplog.text


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
    aligned = align_frames(hands, ("0030", "0009", "0010"), 4, "b.npz")
    np.testing.assert_array_equal(aligned.boxes_px[0], boxes[2])
    np.testing.assert_array_equal(aligned.boxes_px[1], boxes[0])
    assert np.isnan(aligned.boxes_px[2]).all()
    unnamed = align_frames(hands._replace(frames=None), ("x", "y", "z"), 4, "b.npz")
    assert unnamed.frames == ("x", "y", "z")
    one = HandBoxes(boxes[:1], ("left", "right"), ("9",))
    assert align_frames(one, ("0000",), 4, "b.npz").frames == ("0000",)
    with pytest.raises(ValueError, match="`frames` must differ from each other"):
        align_frames(hands._replace(frames=("9", "09", "30")), ("9", "12"), 4, "b.npz")
    with pytest.raises(ValueError, match=r"the rig has 3 views; the boxes have 4"):
        align_frames(hands, ("9",), 3, "b.npz")
    with pytest.raises(ValueError, match=r"the capture has 2 frames, the boxes 3; add `frames"):
        align_frames(hands._replace(frames=None), ("x", "y"), 4, "b.npz")
    with pytest.raises(ValueError, match=r"no frame of the capture \(7, \.\.\.\) is among its `frames`"):
        align_frames(hands, ("7",), 4, "b.npz")


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
