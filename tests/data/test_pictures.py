"""Decoding and warping: the calibrated pixels, whichever decoder, and where they go."""

import struct
import sys

import cv2
import numpy as np
import pytest

from poem_jax.data.frames import EncodedImage
from poem_jax.data.pictures import (
    OPENCV,
    Picture,
    apply_gains,
    decode,
    decode_shrunk,
    decoder,
    eighths_for,
    warp,
)

SMOOTH = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (61, 93, 3), np.uint8), (0, 0), 6)
SMOOTH = cv2.normalize(SMOOTH, None, 0, 255, cv2.NORM_MINMAX)
DECODERS = ["opencv", "turbo"]


def chosen(name: str):
    if name == "turbo":
        pytest.importorskip("simplejpeg")
    return decoder(name)


def encoded(kind: str = "jpg", orientation: int | None = None) -> EncodedImage:
    data = cv2.imencode(f".{kind}", SMOOTH[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    if orientation is not None:
        exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIHxx", 8, 1, 0x0112, 3, 1, orientation) + bytes(4)
        data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    return EncodedImage(data, f"shard.tar: a.{kind}")


@pytest.mark.parametrize("name", DECODERS)
@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_images_come_as_rgb(name, kind):
    image = decode(encoded(kind), (93, 61), chosen(name))
    assert image.flags.c_contiguous
    assert np.abs(image.astype(int) - SMOOTH).mean() <= (0 if kind == "png" else 4)


@pytest.mark.parametrize("name", DECODERS)
def test_the_calibrated_size_decides_a_turn(name):
    image = encoded(orientation=6)
    stored = decode(image, (93, 61), chosen(name))
    turned = decode(image, (61, 93), chosen(name))
    np.testing.assert_array_equal(turned, cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE))
    with pytest.raises(ValueError, match=r"^shard\.tar: a\.jpg is 93 x 61 .*calibrated at 64 x 64"):
        decode(image, (64, 64), chosen(name))
    with pytest.raises(ValueError, match=r"^shard\.tar: a\.jpg has EXIF orientation 3"):
        decode(encoded(orientation=3), (93, 61), chosen(name))


@pytest.mark.parametrize("name", DECODERS)
def test_damage_names_the_image(name):
    whole = encoded()
    for data in (b"", whole.data[:-40], whole.data[:30], b"text"):
        with pytest.raises(ValueError, match=r"^shard\.tar: a\.jpg cannot be read"):
            decode(whole._replace(data=data), (93, 61), chosen(name))


def test_turbo_refuses_data_that_end_too_soon():
    whole = encoded()
    cut = whole._replace(data=whole.data[:-400] + whole.data[-2:])
    with pytest.raises(ValueError, match=r"^shard\.tar: a\.jpg cannot be read"):
        decode(cut, (93, 61), chosen("turbo"))


def test_a_decoder_that_is_not_there(monkeypatch):
    assert decoder("opencv") is OPENCV
    with pytest.raises(ValueError, match='is "opencv" or "turbo"; got \'pillow\''):
        decoder("pillow")
    monkeypatch.setitem(sys.modules, "simplejpeg", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "poem-jax\[turbo\]"'):
        decoder("turbo")


def test_eighths_never_enlarge():
    scales = np.linspace(0.01, 3, 50)
    eighths = np.array([eighths_for(scale) for scale in scales])
    assert (eighths / 8 >= np.minimum(scales, 1)).all()
    assert (eighths / 8 - scales < 1 / 8).all()
    assert eighths.min() == 1
    assert eighths.max() == 8


@pytest.mark.parametrize("eighths", [2, 3, 4, 7])
def test_a_picture_shrunk_while_decoding_lies_where_it_lay(eighths):
    """The sides are no multiples of 8: the scale is that of the blocks, not that of the sizes."""
    picture = decode_shrunk(encoded(), (93, 61), eighths, chosen("turbo"))
    assert picture.rgb.shape == (-(-61 * eighths // 8), -(-93 * eighths // 8), 3)
    assert picture.scale == eighths / 8
    H = np.array([[0.25, 0, 0], [0, 0.25, 0], [0, 0, 1]])
    whole = cv2.GaussianBlur(decode(encoded(), (93, 61)), (0, 0), 1.2)
    expected = warp(Picture(whole, 1.0), H, (15, 23))[2:-2, 2:-2].astype(float)
    shrunk = warp(picture, H, (15, 23))[2:-2, 2:-2].astype(float)
    shifted = warp(picture, H + np.array([[0, 0, 0.5], [0, 0, 0], [0, 0, 0]]), (15, 23))[2:-2, 2:-2]
    assert 3 * np.abs(shrunk - expected).mean() < np.abs(shifted - expected).mean()


def test_turned_images_and_pngs_are_not_shrunk():
    for image, size in ((encoded(orientation=6), (61, 93)), (encoded("png"), (93, 61))):
        assert decode_shrunk(image, size, 4, chosen("turbo")).scale == 1
    assert decode_shrunk(encoded(), (93, 61), 4, OPENCV).scale == 1


def test_the_mirror_is_that_of_pixels():
    picture = Picture(SMOOTH, 1.0)
    np.testing.assert_array_equal(warp(picture, np.eye(3), (61, 93), 93 / 2), SMOOTH[:, ::-1])
    # Column 0 goes to 2 * 40.5 - 0.5 = 80.5, the centre of column 80.
    mirrored = warp(picture, np.eye(3), (61, 93), 40.5)
    np.testing.assert_array_equal(mirrored[:, :81], SMOOTH[:, 80::-1])
    assert not mirrored[:, 81:].any()


def test_gains_truncate_and_hold():
    gains = np.array([1.3, 0.7, 0.999])
    expected = np.clip(SMOOTH * gains, 0, 255).astype(np.uint8)
    np.testing.assert_array_equal(apply_gains(SMOOTH, gains), expected)
