"""Hands in images: what MediaPipe itself finds in photographs, videos, and images without a hand."""

import cv2
import numpy as np
import pytest

from poem_jax.calibration.rig_json import read_rig
from poem_jax.data.lens import project_raw
from poem_jax.detection import HandTracker, find_hands
from poem_jax.detection import detector as detector_module
from poem_jax.detection.regions import Region
from poem_jax.io.images import read_image
from tests.one_hand.capture import one_hand_folder

ONE_HAND = one_hand_folder()

SIDE_OF_LABEL = {"Left": "right", "Right": "left"}
"""MediaPipe names sides as if images were mirrored."""
MAX_PX = {"caliscope_": (0.01, 0.05), "": (0.01, 0.05)}
"""Median and 90th percentile of the distances to MediaPipe's key points, by the start of an image's path."""


def read_stored(path) -> np.ndarray:
    """An image as stored, not turned by EXIF: MediaPipe was fed so."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@pytest.fixture(scope="module")
def golden(shared_dir):
    """Images by path, and what MediaPipe finds in them."""
    stored = np.load(shared_dir / "reference" / "mediapipe_hands" / "golden_static.npz")
    images = {str(path): read_stored(shared_dir / "data" / str(path)) for path in stored["images"]}
    return images, stored


def test_hands_of_photographs_are_mediapipes(golden):
    images, stored = golden
    distances: dict[str, list[np.ndarray]] = {start: [] for start in MAX_PX}
    for path, hands in zip(images, find_hands(list(images.values())), strict=True):
        expected = np.flatnonzero(stored["image"] == path)
        assert len(hands) == len(expected), path
        keypoints = stored["keypoints_px"][expected]
        apart = [[np.linalg.norm(k - hand.keypoints_px, axis=-1) for hand in hands] for k in keypoints]
        nearest = [int(np.argmin([d.max() for d in row])) for row in apart]
        assert sorted(nearest) == list(range(len(hands))), path
        for row, index, number in zip(apart, nearest, expected, strict=True):
            assert hands[index].side == SIDE_OF_LABEL[str(stored["mediapipe_label"][number])], path
            assert hands[index].side_score == pytest.approx(stored["score"][number], abs=2e-3)
            distances[next(start for start in MAX_PX if path.startswith(start))].append(row[index])
    for start, (median, most) in MAX_PX.items():
        found = np.concatenate(distances[start])
        assert np.median(found) <= median
        assert np.quantile(found, 0.9) <= most


def test_a_video_is_followed_without_looking_for_palms(golden, monkeypatch):
    images, _ = golden
    image = images["caliscope_4cam_hands/frames/0009/cam_0.jpg"]
    ((first, second),) = find_hands([image])
    tracker = HandTracker()
    assert len(tracker.find_hands(image)) == 2
    looked = []
    monkeypatch.setattr(detector_module, "_regions_of_palms", lambda *a: looked.append(a) or [[]])
    for shift in (3, 6, 9):
        moved = np.roll(image, shift, axis=1)
        hands = tracker.find_hands(moved)
        assert {hand.side for hand in hands} == {first.side, second.side}
        for hand in hands:
            still = first if hand.side == first.side else second
            size = np.ptp(still.keypoints_px, axis=0).max()
            error = np.linalg.norm(hand.keypoints_px - still.keypoints_px - [shift, 0], axis=-1)
            assert np.median(error) < 0.05 * size
    assert not looked
    tracker.find_hands(np.zeros_like(image))
    assert looked


def test_what_is_no_hand_gives_its_place_to_a_hand(golden):
    images, _ = golden
    image = images["caliscope_4cam_hands/frames/0009/cam_0.jpg"]
    tracker = HandTracker()
    tracker._last = [Region(np.array([40.0, 40.0]), 60.0, 0.0), Region(np.array([1200.0, 60.0]), 60.0, 0.0)]
    assert {hand.side for hand in tracker.find_hands(image)} == {"left", "right"}


def test_a_rendered_hand_is_found():
    """The network was trained on real ones."""
    image = read_image(ONE_HAND / "cam_0.jpg")
    ((hand,),) = find_hands([image, image])[:1]
    truth = np.load(ONE_HAND / "ground_truth.npz")
    joints = truth["joints_world"].reshape(-1, 21, 3)[0]
    rig = read_rig(ONE_HAND / "rig.json")
    expected = project_raw(rig, 0, joints)[0]
    size = np.ptp(expected, axis=0).max()
    assert hand.side == "right"
    assert np.median(np.linalg.norm(hand.keypoints_px - expected, axis=-1)) < 0.1 * size


def test_an_image_wider_than_opencv_takes_is_refused():
    with pytest.raises(ValueError, match="at most 32766 pixels wide and high"):
        find_hands([np.zeros((1, 40000, 3), np.uint8)])


def test_images_of_any_size_are_searched_together(golden):
    images, stored = golden
    image = images[str(stored["image"][0])]
    small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    alone, _, nothing = find_hands([image, small, np.full((100, 90, 3), 128, np.uint8)])
    ((again),) = find_hands([image])
    assert nothing == []
    assert len(alone) == len(again)
    for a, b in zip(alone, again, strict=True):
        np.testing.assert_allclose(a.keypoints_px, b.keypoints_px, atol=1e-3)


def test_no_image_and_no_hand():
    assert find_hands([]) == []
    assert find_hands([np.zeros((1, 1, 3), np.uint8), np.full((33, 500, 3), 200, np.uint8)]) == [[], []]


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((8, 8), np.uint8),
        np.zeros((8, 8, 4), np.uint8),
        np.zeros((8, 8, 3)),
        np.zeros((0, 8, 3), np.uint8),
    ],
)
def test_what_is_no_rgb_image_is_refused(image):
    good = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(ValueError, match=r"\(h, w, 3\) of uint8; number 1 has shape"):
        find_hands([good, image])


def test_the_number_of_hands_must_be_positive():
    with pytest.raises(ValueError, match="`max_hands` must be 1 or more; got 0"):
        find_hands([], max_hands=0)
    image = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(ValueError, match="`max_hands`"):
        HandTracker(0).find_hands(image)
