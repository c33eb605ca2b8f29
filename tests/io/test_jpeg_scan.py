"""JPEGs that are damaged where it shows without decoding, and odd ones that are whole."""

import cv2
import numpy as np
import pytest

from poem_jax.io.images import read_header

WIDTH, HEIGHT = 93, 61


@pytest.fixture(scope="module")
def pixels():
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 1)


@pytest.fixture(scope="module")
def jpeg(pixels):
    return encoded(pixels)


def encoded(pixels, *options):
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 98, *options])[1].tobytes()


def scan_of(jpeg):
    """Where the coded pixels lie."""
    start = jpeg.rindex(b"\xff\xda")
    return start + 2 + int.from_bytes(jpeg[start + 2 : start + 4]), len(jpeg) - 2


def put(jpeg, place, content):
    return jpeg[:place] + content + jpeg[place + len(content) :]


@pytest.mark.parametrize(
    "options",
    [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 3)],
    ids=["plain", "progressive", "restarts"],
)
def test_whole_jpegs_of_every_kind_pass(pixels, options):
    jpeg = encoded(pixels, *options)
    assert jpeg.count(b"\xff\xda") > 1 or cv2.IMWRITE_JPEG_PROGRESSIVE not in options
    assert jpeg.count(b"\xff\xd3") or cv2.IMWRITE_JPEG_RST_INTERVAL not in options
    for whole in (jpeg, jpeg + jpeg, jpeg + b"\xff\xd8 of a phone", jpeg[:-2] + b"\xff\xff" + jpeg[-2:]):
        assert read_header(whole, "a.jpg").size_wh == (WIDTH, HEIGHT)


def test_a_bit_that_makes_or_breaks_a_marker_is_seen(jpeg):
    start, end = scan_of(jpeg)
    stuffed = jpeg.index(b"\xff\x00", start)
    with pytest.raises(ValueError, match=rf"^a\.jpg cannot be read .*ff 10 at {stuffed} are no marker"):
        read_header(put(jpeg, stuffed + 1, b"\x10"), "a.jpg")
    with pytest.raises(ValueError, match=r"^a\.jpg .*the restart marker d4 at \d+ is out of its order"):
        read_header(put(jpeg, stuffed + 1, b"\xd4"), "a.jpg")
    almost = next(i for i in range(start, end) if jpeg[i] == 0xFE and jpeg[i + 1] not in (0, 0xD9, 0xFF))
    with pytest.raises(ValueError, match=r"^a\.jpg cannot be read"):
        read_header(put(jpeg, almost, b"\xff"), "a.jpg")


def test_lost_restarts_and_cut_ends_are_seen(pixels, jpeg):
    restarts = encoded(pixels, cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
    lost = restarts.index(b"\xff\xd2")
    with pytest.raises(ValueError, match=r"the restart marker d3 at .* is out of its order"):
        read_header(restarts[:lost] + restarts[lost + 2 :], "a.jpg")
    for cut in (jpeg[:-2], jpeg[:-40]):
        with pytest.raises(ValueError, match=r"a\.jpg .*it breaks off"):
            read_header(cut, "a.jpg")


def test_of_all_wrong_bits_in_coded_pixels_few_show_and_the_rest_is_another_picture(jpeg):
    """What docs/data.md says of them: about 1 in 100."""
    start, end = scan_of(jpeg)
    seen, places = 0, range(start, end - 2, 5)
    for place in places:
        try:
            read_header(put(jpeg, place, bytes([jpeg[place] ^ (1 << place // 5 % 8)])), "a.jpg")
        except ValueError:
            seen += 1
    assert 0.003 < seen / len(places) < 0.05
