"""Images: the pixels that the calibration belongs to, or an error; sizes are known before decoding."""

import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from poem_jax.io import images
from poem_jax.io.images import MAX_PIXELS, read_image

WIDE = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (12, 20, 3), np.uint8), (0, 0), 2)
SQUARE = np.ascontiguousarray(WIDE[:, :12])


def exif(orientation: int, order: str = "<") -> bytes:
    start = b"II*\0" if order == "<" else b"MM\0*"
    entries = [(0x0100, 4, 1, 20 << (0 if order == "<" else 16)), (0x0112, 3, 1, orientation)]
    packed = b"".join(struct.pack(f"{order}HHIHxx", *entry[:3], entry[3] & 0xFFFF) for entry in entries)
    return start + struct.pack(f"{order}IH", 8, len(entries)) + packed + bytes(4)


def jpeg(image: np.ndarray, orientation: int | None = None, order: str = "<") -> bytes:
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    if orientation is None:
        return data
    content = b"Exif\0\0" + exif(orientation, order)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content + data[2:]


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(image: np.ndarray, *more: bytes) -> bytes:
    data = cv2.imencode(".png", image)[1].tobytes()
    return data[:33] + b"".join(more) + data[33:]


def png_that_claims(width: int, height: int) -> bytes:
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return start + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_turn_is_that_of_opencv(orientation, order, tmp_path: Path):
    path = write(tmp_path / "a.jpg", jpeg(WIDE, orientation, order))
    shown = cv2.imread(str(path))
    np.testing.assert_array_equal(read_image(path), shown[..., ::-1])


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_the_rigs_size_tells_whether_its_pixels_are_turned(orientation, tmp_path: Path):
    path = write(tmp_path / "a.jpg", jpeg(WIDE, orientation))
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    np.testing.assert_array_equal(read_image(path, (20, 12)), stored[..., ::-1])
    np.testing.assert_array_equal(read_image(path, (12, 20)), cv2.imread(str(path))[..., ::-1])
    with pytest.raises(
        ValueError, match=rf"is 20 x 12 \(turned by its EXIF orientation {orientation}\); the rig"
    ):
        read_image(path, (24, 12))


@pytest.mark.parametrize(("image", "orientation"), [(WIDE, 2), (WIDE, 3), (WIDE, 4), (SQUARE, 6)])
@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_a_turn_that_the_size_cannot_decide_is_refused(image, orientation, kind, tmp_path: Path):
    data = jpeg(image, orientation) if kind == "jpg" else png(image, chunk(b"eXIf", exif(orientation)))
    path = write(tmp_path / f"a.{kind}", data)
    with pytest.raises(ValueError, match=f"has EXIF orientation {orientation}, .* turned and not turned"):
        read_image(path, image.shape[1::-1])


@pytest.mark.parametrize("damage", [b"Exif\0\0", b"Exif\0\0II*\0\xff\xff\xff\xff", b"Exif\0\0" + exif(9)])
def test_an_orientation_that_cannot_be_read_counts_as_none(damage, tmp_path: Path):
    data = jpeg(WIDE)
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(damage) + 2) + damage + data[2:]
    assert read_image(write(tmp_path / "a.jpg", data), (20, 12)).shape == (12, 20, 3)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("grey", [False, True])
def test_sixteen_bit_images_are_scaled_by_their_true_depth(bits, grey, tmp_path: Path, caplog, monkeypatch):
    monkeypatch.setattr(images, "_said_depths", set())
    full = np.array(WIDE).astype(np.uint16)
    full = full[..., 1] if grey else full
    full.flat[0] = 255
    path = write(tmp_path / "a.png", png(full << (bits - 8)))
    for _ in range(2):
        image = read_image(path, (20, 12))
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, full[..., None].repeat(3, -1) if grey else full[..., ::-1])
    assert [f"image of {bits} bits" in text for text in caplog.messages] == [True] * (bits < 16)


def test_grey_alpha_and_palette(tmp_path: Path):
    grey = write(tmp_path / "grey.png", png(WIDE[..., 0]))
    np.testing.assert_array_equal(read_image(grey), WIDE[..., :1].repeat(3, -1))
    alpha = write(tmp_path / "alpha.png", png(np.dstack([WIDE, WIDE[..., 0] * 0])))
    np.testing.assert_array_equal(read_image(alpha), WIDE[..., ::-1])
    jpeg_grey = read_image(write(tmp_path / "grey.jpg", jpeg(WIDE[..., 0])))
    assert np.ptp(jpeg_grey, axis=-1).max() == 0


@pytest.mark.parametrize("size", [(60000, 60000), (30000, 30000), (2**31, 2**31 - 1), (0, 5)])
def test_a_header_that_claims_too_much_is_refused_before_decoding(size, tmp_path: Path):
    path = write(tmp_path / "a.png", png_that_claims(*size))
    tracemalloc.start()
    for rig in (None, (20, 12), size):
        with pytest.raises(ValueError, match=rf"says it is {size[0]} x {size[1]}.* 1 to {MAX_PIXELS} pixels"):
            read_image(path, rig)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_the_rigs_size_is_checked_before_decoding(tmp_path: Path):
    with pytest.raises(ValueError, match="is 9000 x 9000; the rig was calibrated at 20 x 12"):
        read_image(write(tmp_path / "a.png", png_that_claims(9000, 9000)), (20, 12))


WHOLE = {"png": png(WIDE), "jpg": jpeg(WIDE)}
DAMAGED = {
    "empty": b"",
    "text": b"not an image",
    "webp": b"RIFF\0\0\0\0WEBPVP8 ",
    "png cut": WHOLE["png"][:-100],
    "png start": WHOLE["png"][:30],
    "png flipped": WHOLE["png"][:100] + b"\0\0\0\0" + WHOLE["png"][104:],
    "png without pixels": WHOLE["png"][:33] + chunk(b"IEND", b""),
    "jpg cut": WHOLE["jpg"][:-20],
    "jpg start": WHOLE["jpg"][:5],
    "jpg without a size": WHOLE["jpg"].replace(b"\xff\xc0", b"\xff\xfe"),
    "jpg torn": WHOLE["jpg"][:20] + b"\0" * 20 + WHOLE["jpg"][40:],
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_is_named(name, tmp_path: Path):
    with pytest.raises(ValueError, match=r"a\.png cannot be read as an image.* damaged"):
        read_image(write(tmp_path / "a.png", DAMAGED[name]), (20, 12))


def test_no_image(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="no image at"):
        read_image(tmp_path / "none.png")
    with (tmp_path / "big.png").open("wb") as stream:
        stream.truncate(2**31)
    with pytest.raises(ValueError, match=r"big\.png has 2147483648 bytes"):
        read_image(tmp_path / "big.png")
