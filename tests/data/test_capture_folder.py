"""Capture folders: both layouts, natural order, and what is said about missing and unreadable images."""

import unicodedata

import cv2
import numpy as np
import pytest

from poem_jax.data.capture_folder import SINGLE_FRAME, find_frames
from poem_jax.io.images import read_image

CAMERAS = ("a", "b")


def put(path, hw=(6, 8), value=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((*hw, 3), value, np.uint8)
    image[..., 0] = 200  # blue, as OpenCV writes it
    assert cv2.imwrite(str(path), image)
    return path


def test_one_frame(tmp_path):
    put(tmp_path / "a.png")
    put(tmp_path / "b.JPG")
    put(tmp_path / "other.png")
    (frame,) = find_frames(tmp_path, CAMERAS)
    assert frame.name == SINGLE_FRAME
    assert [path.name for path in frame.images] == ["a.png", "b.JPG"]


def test_a_take_in_natural_order_with_a_gap(tmp_path):
    for name in ("10", "9", "x2", "x10"):
        put(tmp_path / "frames" / name / "a.png")
    put(tmp_path / "frames" / "10" / "b.png")
    frames = find_frames(tmp_path, CAMERAS)
    assert [frame.name for frame in frames] == ["9", "10", "x2", "x10"]
    assert frames[0].images[1] is None
    assert frames[1].images[1] is not None


def test_images_are_rgb(tmp_path):
    image = read_image(put(tmp_path / "a.png"), (8, 6))
    assert image.shape == (6, 8, 3)
    assert image[0, 0].tolist() == [0, 0, 200]


def test_errors(tmp_path):
    with pytest.raises(FileNotFoundError, match="no capture folder"):
        find_frames(tmp_path / "none", CAMERAS)
    with pytest.raises(FileNotFoundError, match=r"no image of the rig's cameras in .* expected a\.jpg"):
        find_frames(tmp_path, CAMERAS)
    path = put(tmp_path / "a.png")
    put(tmp_path / "a.jpg")
    with pytest.raises(ValueError, match=r"two images of one camera: a\.jpg and a\.png"):
        find_frames(tmp_path, CAMERAS)
    with pytest.raises(ValueError, match=r"a\.png is 8 x 6; the rig was calibrated at 16 x 12"):
        read_image(path, (16, 12))
    with pytest.raises(FileNotFoundError, match="no image at"):
        read_image(tmp_path / "none.png", (8, 6))
    assert cv2.imwrite(str(tmp_path / "b.jpg"), np.random.default_rng(0).integers(0, 255, (6, 8, 3)))
    jpeg = (tmp_path / "b.jpg").read_bytes()
    assert read_image(tmp_path / "b.jpg", (8, 6)).shape == (6, 8, 3)
    (tmp_path / "cut.jpg").write_bytes(jpeg[:-20])
    with pytest.raises(ValueError, match="cannot be read as an image"):
        read_image(tmp_path / "cut.jpg", (8, 6))
    for name, data in (
        ("text.png", b"not an image"),
        ("empty.png", b""),
        ("cut.png", path.read_bytes()[:40]),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match="cannot be read as an image"):
            read_image(tmp_path / name, (8, 6))


@pytest.mark.parametrize("name", [".ipynb_checkpoints", ".thumbnails", "@eaDir", "#recycle", "__MACOSX"])
def test_folders_of_the_system_are_no_frames(tmp_path, name):
    for frame in ("frame_2", "frame_10"):
        put(tmp_path / "frames" / frame / "a.png")
    put(tmp_path / "frames" / name / "a.png")
    assert [frame.name for frame in find_frames(tmp_path, CAMERAS)] == ["frame_2", "frame_10"]


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_meet_in_either_form_of_unicode(tmp_path, form):
    put(tmp_path / f"{unicodedata.normalize(form, 'höhe')}.JPG")
    (frame,) = find_frames(tmp_path, [unicodedata.normalize("NFC", "höhe")])
    assert frame.images[0] is not None


def test_images_of_other_names_are_listed(tmp_path):
    put(tmp_path / "Cam0.jpg")
    with pytest.raises(FileNotFoundError, match=r"expected a\.jpg .*; found Cam0\.jpg"):
        find_frames(tmp_path, CAMERAS)
