"""Key points from images: sides, places, missing images, and how MediaPipe is asked."""

import importlib
import importlib.util
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from poem_jax.capture.detect import SIDES, Detection, detect_hands, one_of_each_side
from poem_jax.capture.folder import FramePaths
from poem_jax.cli import main
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


def test_a_search_that_is_stopped_keeps_the_frames_that_are_done(capture):
    frames, rig = capture
    kept = []

    def stopped_at_the_second(image):
        if image[0, 0, 0] == 20:
            raise KeyboardInterrupt
        return [found("left", 0.9)]

    with pytest.raises(KeyboardInterrupt):
        detect_hands(frames, rig, detector=stopped_at_the_second, when_stopped=kept.append, progress=False)
    (hands,) = kept
    assert hands.frames == ("0",)
    np.testing.assert_array_equal(hands.keypoints_px[0, 1, 0], found("left", 0.9).keypoints_px)


def scores(*detections: Detection) -> dict[str, float]:
    return {side: hand.score for side, hand in one_of_each_side(detections).items()}


def test_of_two_hands_of_one_side_the_less_sure_is_the_other():
    assert scores(found("right", 0.6, 100.0), found("right", 0.9)) == {"right": 0.9, "left": 0.6}


def test_one_hand_found_twice_is_one_hand():
    assert scores(found("right", 0.6, 2.0), found("right", 0.9)) == {"right": 0.9}


def test_a_side_that_was_found_is_not_replaced():
    hands = found("right", 0.6, 100.0), found("right", 0.9), found("left", 0.1, 200.0)
    assert scores(*hands) == {"right": 0.9, "left": 0.1}


def test_mediapipe_is_asked_and_understood(capture, monkeypatch):
    """A stand-in for MediaPipe: mirrored sides, shares of the image, guesses beyond its border."""
    frames, rig = capture
    asked = {}

    class Hands:
        def __init__(self, **options):
            asked.update(options)

        def process(self, image):
            points = [SimpleNamespace(x=0.25 + 0.01 * i, y=0.5 + 0.02 * i) for i in range(20)]
            hand = SimpleNamespace(landmark=[*points, SimpleNamespace(x=1.01, y=0.5)])
            side = SimpleNamespace(classification=[SimpleNamespace(label="Left", score=0.9)])
            empty = image[0, 0, 0] == 10
            return SimpleNamespace(
                multi_hand_landmarks=None if empty else [hand], multi_handedness=None if empty else [side]
            )

    fake = SimpleNamespace(solutions=SimpleNamespace(hands=SimpleNamespace(Hands=Hands)))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(importlib, "import_module", lambda name: fake)
    hands = detect_hands(frames, rig, progress=False)
    assert asked == {
        "static_image_mode": True,
        "max_num_hands": 2,
        "model_complexity": 1,
        "min_detection_confidence": 0.5,
    }
    keypoints = hands.keypoints_px[1, SIDES.index("right"), 0]
    np.testing.assert_allclose(keypoints[3], [0.28 * 64, 0.56 * 48])
    assert np.isnan(keypoints[20]).all()
    assert np.isfinite(hands.keypoints_px).all((-1, -2)).sum() == 0
    assert np.isfinite(hands.boxes_px).all(-1).sum() == 1


def test_no_hand_at_all_is_an_error(capture):
    frames, rig = capture
    with pytest.raises(ValueError, match="no hand was found"):
        detect_hands(frames, rig, detector=lambda image: [], progress=False)


def test_without_mediapipe_the_message_says_how_to_get_it(capture, monkeypatch):
    frames, rig = capture
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"poem-jax\[detect\]"):
        detect_hands(frames, rig)


@pytest.mark.parametrize("name", ["rig.json", "front.png"])
def test_key_points_do_not_replace_what_they_are_found_in(make_capture, capsys, name):
    folder = make_capture().folder
    before = (folder / name).read_bytes()
    assert main(["detect", str(folder), "--out", str(folder / name)]) == 2
    assert f"{name} would be replaced by a result, and is read; give another --out" in capsys.readouterr().err
    assert (folder / name).read_bytes() == before
