"""Images as cameras and programs write them, searched by `poem detect`: the hands stay where they are."""

import json
import logging

import cv2
import numpy as np
import pytest

from poem_jax.capture.association import associate_hands
from poem_jax.capture.boxes_file import read_boxes
from poem_jax.capture.rig_file import read_rig
from poem_jax.cli import main
from poem_jax.data.capture_folder import find_frames
from poem_jax.detection import HandTracker, find_hands
from poem_jax.io.images import read_image
from tests.one_hand.capture import one_hand_folder

CAMERAS = tuple(f"cam_{view}" for view in range(4))


@pytest.fixture(scope="module")
def pictures():
    """The bundled capture, BGR."""
    return {name: cv2.imread(str(one_hand_folder() / f"{name}.jpg")) for name in CAMERAS}


@pytest.fixture
def take(tmp_path):
    """Write a take: a rig whose pictures were moved and scaled, and the encoded images of its frames."""

    def write(frames, maps=None):
        rig = json.loads((one_hand_folder() / "rig.json").read_text())
        for camera in rig["cameras"]:
            scale, (left, top), (width, height) = (maps or {}).get(camera["name"], (1, (0, 0), (512, 512)))
            K = np.array(camera["K"])
            # Pixel (0, 0) of a rig is the centre of its first pixel.
            K[:2, 2] = (K[:2, 2] + 0.5) * scale + (left, top) - 0.5
            K[0, 0], K[1, 1] = K[0, 0] * scale, K[1, 1] * scale
            camera.update(K=K.tolist(), width=width, height=height)
        (tmp_path / "rig.json").write_text(json.dumps(rig))
        for number, images in enumerate(frames):
            folder = tmp_path / "frames" / f"{number}"
            folder.mkdir(parents=True)
            for name, (suffix, data) in images.items():
                (folder / f"{name}{suffix}").write_bytes(data)
        return tmp_path

    return write


def encoded(picture, suffix=".png"):
    done, data = cv2.imencode(suffix, picture)
    assert done
    return suffix, data.tobytes()


def turned_jpeg(picture):
    """As a camera on its side writes it: stored a quarter turn to the left, with a tag to turn it back."""
    _, data = encoded(np.rot90(picture, 1), ".jpg")
    tag = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    return ".jpg", data[:2] + b"\xff\xe1" + (len(tag) + 2).to_bytes(2, "big") + tag + data[2:]


def detected(folder):
    """Return the key points (frame, hand, view, 21, 2) that `poem detect` writes."""
    out = folder / "found.npz"
    assert main(["detect", str(folder), "--out", str(out)]) == 0
    return read_boxes(out).keypoints_px


@pytest.fixture(scope="module")
def plain(pictures, tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    (folder / "frames" / "0").mkdir(parents=True)
    (folder / "rig.json").write_bytes((one_hand_folder() / "rig.json").read_bytes())
    for name, picture in pictures.items():
        (folder / "frames" / "0" / f"{name}.png").write_bytes(encoded(picture)[1])
    found = detected(folder)
    # The others are too near: the network was trained on real hands.
    assert np.isfinite(found[0, 0]).all((-1, -2))[[0, 2]].all()
    return found


def hand_distance(found, expected):
    """Median distance of the key points (21, 2) over the hand's size."""
    return np.median(np.linalg.norm(found - expected, axis=-1)) / np.ptp(expected, axis=0).max()


KINDS = {
    "grey": lambda picture: encoded(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)),
    "with alpha": lambda picture: encoded(np.dstack([picture, np.full((512, 512), 128, np.uint8)])),
    "of 16 bits": lambda picture: encoded(picture.astype(np.uint16) * 257),
    "turned": lambda picture: turned_jpeg(cv2.copyMakeBorder(picture, 0, 0, 0, 88, cv2.BORDER_REPLICATE)),
}
MAX_APART = {"grey": 0.1, "with alpha": 1e-6, "of 16 bits": 1e-6, "turned": 0.05}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_shows_the_same_hand(take, pictures, plain, kind):
    images = {name: encoded(picture) for name, picture in pictures.items()}
    images["cam_0"] = KINDS[kind](pictures["cam_0"])
    maps = {"cam_0": (1, (0, 0), (600, 512))} if kind == "turned" else {}
    found = detected(take([images], maps))
    assert hand_distance(found[0, 0, 0], plain[0, 0, 0]) <= MAX_APART[kind]


@pytest.mark.parity
def test_large_and_small_images_show_the_same_hands(shared_dir, tmp_path):
    """Of 3840 x 2160, and of 178 x 100, where hands of 10 to 20 pixels are found in most views."""
    data = shared_dir / "data" / "caliscope_4cam_hands"
    rig = read_rig(data / "calibration" / "rig.json")
    paths = [frame.images for frame in find_frames(data, rig.names)[:6]]
    pictures = [read_image(path) for images in paths for path in images]
    plain = find_hands(pictures)
    for size_wh, max_apart, min_found in (((3840, 2160), 0.02, 1.0), ((178, 100), 0.1, 0.7)):
        scale = np.array(size_wh) / (1280, 720)
        resized = [cv2.resize(picture, size_wh, interpolation=cv2.INTER_AREA) for picture in pictures]
        nearest = [
            min((hand_distance(one.keypoints_px / scale, hand.keypoints_px) for one in found), default=np.inf)
            for found, hands in zip(find_hands(resized), plain, strict=True)
            for hand in hands
        ]
        assert np.mean(np.isfinite(nearest)) >= min_found
        assert np.median(nearest) < max_apart, size_wh


def test_a_covered_camera_and_a_damaged_file_do_not_stop_the_rest(take, pictures, caplog):
    images = {name: encoded(picture) for name, picture in pictures.items()}
    images["cam_3"] = encoded(np.zeros((512, 512, 3), np.uint8))
    damaged = images | {"cam_0": (".png", images["cam_0"][1][:5000])}
    with caplog.at_level(logging.WARNING):
        found = detected(take([images, damaged, images]))
    seen = np.isfinite(found[:, 0]).all((-1, -2))
    np.testing.assert_array_equal(seen[[0, 2]][:, [0, 2, 3]], [[True, True, False]] * 2)
    np.testing.assert_array_equal(seen[1][[0, 2, 3]], [False, True, False])
    assert "camera 'cam_3' shows no hand in any image: is it covered?" in caplog.text
    assert "frame 1: an image is left out" in caplog.text
    assert "cam_0.png" in caplog.text


def test_a_take_without_hands_is_told(take, capsys):
    grey = encoded(np.full((512, 512, 3), 90, np.uint8))
    folder = take([dict.fromkeys(CAMERAS, grey)])
    assert main(["detect", str(folder), "--out", str(folder / "found.npz")]) == 2
    assert "no hand was found in any image of 1 frames" in capsys.readouterr().err
    assert not (folder / "found.npz").exists()


@pytest.mark.parity
def test_hands_are_followed_through_a_video(shared_dir):
    """Tracking finds what looking at each frame finds, in the same hands."""
    rig = read_rig(shared_dir / "data" / "caliscope_4cam_hands" / "calibration" / "rig.json")
    videos = [
        cv2.VideoCapture(str(shared_dir / "data" / "caliscope_4cam_video" / f"{name}.mp4"))
        for name in rig.names
    ]
    trackers = [HandTracker(2) for _ in videos]
    static, tracked = [], []
    while all(video.grab() for video in videos):
        images = [np.ascontiguousarray(video.retrieve()[1][..., ::-1]) for video in videos]
        static.append(find_hands(images, max_hands=4))
        tracked.append([tracker.find_hands(image) for tracker, image in zip(trackers, images, strict=True)])
    assert len(static) == 34
    names = tuple(map(str, range(len(static))))
    each, followed = (
        associate_hands(found, rig, max_hands=2, frame_names=names) for found in (static, tracked)
    )
    assert each.hand_side == followed.hand_side
    views, followed_views = (
        np.isfinite(hands.keypoints_px).all((-1, -2)).sum(2) >= 2 for hands in (each, followed)
    )
    assert np.all((views & followed_views).sum(0) >= 0.95 * views.sum(0))
    same, other = (
        np.linalg.norm(each.keypoints_px - keypoints, axis=-1).mean(-1)
        for keypoints in (followed.keypoints_px, followed.keypoints_px[:, ::-1])
    )
    both = np.isfinite(same) & np.isfinite(other)
    assert both.sum() > 100
    assert np.all(same[both] < other[both])
    assert np.nanmedian(same) < 5
