"""Key points from images: sides, missing images, and, where MediaPipe is installed, the real thing."""

import importlib.util

import cv2
import numpy as np
import pytest

from poem_jax.capture.detect import SIDES, Detection, detect_hands, one_of_each_side
from poem_jax.capture.folder import FramePaths
from poem_jax.geometry.rig import Rig


def found(side: str, score: float, at: float = 0.0) -> Detection:
    return Detection(side, score, np.arange(42.0).reshape(21, 2) + at)


@pytest.fixture
def capture(tmp_path):
    """Two cameras, two frames; one image is missing, one is damaged."""
    rig = Rig(("a", "b"), np.tile([64, 48], (2, 1)), *(np.zeros((2, *s)) for s in ((3, 3), (5,), (4, 4))))
    for name, value in (("0a", 10), ("1a", 20), ("1b", 30)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((48, 64, 3), value, np.uint8))
    (tmp_path / "1b.png").write_bytes(b"no image")
    frames = [
        FramePaths("0", (tmp_path / "0a.png", None)),
        FramePaths("1", (tmp_path / "1a.png", tmp_path / "1b.png")),
    ]
    return frames, rig


def test_hands_go_to_their_side_frame_and_view(capture, caplog):
    frames, rig = capture
    answers = {10: [found("left", 0.9)], 20: [found("left", 0.8, 1.0), found("right", 0.7, 2.0)]}
    hands = detect_hands(frames, rig, detector=lambda image: answers[image[0, 0, 0]], progress=False)
    assert hands.hand_side == SIDES
    assert hands.frames == ("0", "1")
    seen = np.isfinite(hands.keypoints_px).all((-1, -2))
    np.testing.assert_array_equal(seen, [[[False, False], [True, False]], [[True, False], [True, False]]])
    np.testing.assert_array_equal(hands.keypoints_px[1, 0, 0], answers[20][1].keypoints_px)
    np.testing.assert_array_equal(hands.boxes_px[1, 1, 0], [1, 2, 41, 42])
    assert "1b.png" in caplog.text


def test_of_two_hands_of_one_side_the_less_sure_is_the_other():
    kept = one_of_each_side([found("right", 0.6), found("right", 0.9), found("left", 0.1)])
    assert {side: hand.score for side, hand in kept.items()} == {"right": 0.9, "left": 0.6}


def test_no_hand_at_all_is_an_error(capture):
    frames, rig = capture
    with pytest.raises(ValueError, match="no hand was found"):
        detect_hands(frames, rig, detector=lambda image: [], progress=False)


def test_without_mediapipe_the_message_says_how_to_get_it(capture, monkeypatch):
    frames, rig = capture
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"poem-jax\[detect\]"):
        detect_hands(frames, rig)
