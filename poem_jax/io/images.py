"""Read a camera's image from an untrusted file, as the pixels that the camera's calibration belongs to.

JPEG and PNG. The header is read first, so that an image which claims 10^9 pixels is refused before one of
them is allocated. Two things in a file decide what its pixels are:

A *turn* (EXIF orientation): the stored rows are to be shown turned or mirrored. OpenCV, viewers and labelling
tools do so, other readers do not, and a calibration may come from either. Where the turn swaps the sides, the
size for which the camera was calibrated tells; where it cannot tell, the image is refused.

The *bit depth*: PNGs of 16 bits often hold values of 10, 12 or 14, and no file says so. It is taken as the
smallest of these that holds the largest value; a warning says so once for each depth.
"""

import logging
import os
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.io.jpeg_scan import check_scans
from poem_jax.typing import Array, UInt8

MAX_PIXELS = 2**27
"""134 million, more than any camera's sensor in use for capture; as RGB it takes 0.4 GB."""
_MAX_BYTES = 8 * MAX_PIXELS
"""Of a file: four channels of 16 bits that cannot be compressed."""
BIT_DEPTHS = (8, 10, 12, 14, 16)
"""Of the sensors whose values are stored in 16 bits."""
_PNG_START, _JPEG_START, _EXIF_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"Exif\0\0"
_EXIF_MARKER, _SCAN_MARKER, _RESTART_INTERVAL_MARKER = 0xE1, 0xDA, 0xDD
_SIZE_MARKERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Of the segments of a JPEG that hold its size."""
_LONE_MARKERS = {0x01, *range(0xD0, 0xD9)}
"""Of those that have no contents."""
_ORIENTATION_TAG = 0x0112

_log = logging.getLogger(__name__)


class ImageHeader(NamedTuple):
    """What a JPEG or PNG says of itself before its pixels."""

    size_wh: tuple[int, int]
    """As stored, before any turn."""
    orientation: int = 1
    """EXIF: 1 = as stored, 2..8 = turned by quarters, mirrored or both; from 5 on the sides swap."""
    is_jpeg: bool = False

    @property
    def shown_wh(self) -> tuple[int, int]:
        """Width and height after the turn."""
        width, height = self.size_wh
        return (height, width) if self.orientation >= 5 else (width, height)


def read_image(path: str | os.PathLike, size_wh: tuple[int, int] | None = None) -> UInt8[Array, "h w 3"]:
    """Read an RGB image; grey is repeated, an alpha channel dropped, more than 8 bits are scaled to 8.

    Args:
        path: A JPEG or PNG, whatever its suffix.
        size_wh: Width and height for which the camera was calibrated, pixels; None = any, and the image is
            turned as its orientation says.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is neither JPEG nor PNG, is damaged, has over `MAX_PIXELS` pixels or another size than
            the rig says, or is turned in a way that the rig's size cannot decide.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no image at {path}")
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"{path} has {path.stat().st_size} bytes, too many for an image")
    data = path.read_bytes()
    header = read_header(data, path)
    turned = is_to_be_turned(header, size_wh, path)
    image = decode_stored(data, header, path)
    return turn(image, header.orientation) if turned else image


def read_header(data: bytes, name: str | os.PathLike) -> ImageHeader:
    """Read what an image says of itself.

    Args:
        data: The whole file.
        name: Of the image, for messages; here and below.

    Raises:
        ValueError: It is neither JPEG nor PNG, or is damaged.
    """
    try:
        return _read_header(data)
    except (ValueError, IndexError, struct.error) as error:
        raise ValueError(
            f"{name} cannot be read as an image ({len(data)} bytes); it is damaged or of another kind: "
            f"{error}"
        ) from error


def is_to_be_turned(header: ImageHeader, size_wh: tuple[int, int] | None, name: str | os.PathLike) -> bool:
    """Check the image's size and decide whether to follow its orientation; see `read_image`.

    Raises:
        ValueError: Too many pixels, another size than `size_wh`, or one that cannot decide.
    """
    width, height = header.size_wh
    if not 0 < width * height <= MAX_PIXELS:
        raise ValueError(f"{name} says it is {width} x {height}; an image has 1 to {MAX_PIXELS} pixels")
    if size_wh is None:
        return header.orientation != 1
    as_stored, as_shown = (tuple(size_wh) == size for size in (header.size_wh, header.shown_wh))
    if not as_stored and not as_shown:
        turned = f" (turned by its EXIF orientation {header.orientation})" if header.orientation >= 5 else ""
        raise ValueError(
            f"{name} is {width} x {height}{turned}; the rig was calibrated at {size_wh[0]} x {size_wh[1]}: "
            "use the images as calibrated, or scale `K`, width and height in the rig"
        )
    if header.orientation != 1 and as_stored and as_shown:
        raise ValueError(
            f"{name} has EXIF orientation {header.orientation}, and its size fits the rig turned and not "
            "turned: the calibration may belong to either. Save the images without the tag, as they were "
            "calibrated: turned (`mogrify -auto-orient`), as OpenCV's imread shows them, or as stored "
            "(`exiftool -Orientation= `)"
        )
    return not as_stored


def decode_stored(data: bytes, header: ImageHeader, name: str | os.PathLike) -> UInt8[Array, "h w 3"]:
    """Decode to RGB of 8 bits with OpenCV, as stored, without any turn.

    Raises:
        ValueError: The pixels are damaged.
    """
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ValueError(f"{name} cannot be read as an image: {error.err}") from error
    expected = (*header.size_wh[::-1], 3)
    if bgr is None or bgr.shape != expected or bgr.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{name} cannot be read as an image ({len(data)} bytes): it is damaged")
    return cv2.cvtColor(_eight_bit(bgr, name), cv2.COLOR_BGR2RGB)


def _eight_bit(image: Array, name: str | os.PathLike) -> UInt8[Array, "h w 3"]:
    if image.dtype == np.uint8:
        return image
    largest = int(image.max())
    bits = next(depth for depth in BIT_DEPTHS if largest >> depth == 0)
    if bits < BIT_DEPTHS[-1] and bits not in _said_depths:
        _said_depths.add(bits)
        _log.warning(
            "%s stores 16 bits a value, but none is above %d: it is read as an image of %d bits, and so are "
            "others like it; if that is wrong, save the images with 8 bits",
            *(name, largest, bits),
        )
    return (image >> (bits - 8)).astype(np.uint8)


_said_depths: set[int] = set()
"""Depths that a warning has told of: a long take has a thousand images of each."""


def turn(image: UInt8[Array, "h w 3"], orientation: int) -> UInt8[Array, "shown_h shown_w 3"]:
    """Return the image as an EXIF orientation wants it shown."""
    if orientation >= 5:
        image = image.swapaxes(0, 1)
    # Which of rows and columns then run backwards.
    rows, columns = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return np.ascontiguousarray(image[:: -1 if rows else 1, :: -1 if columns else 1])


def _read_header(data: bytes) -> ImageHeader:
    """Read size and orientation.

    Raises:
        ValueError, IndexError, struct.error: Neither PNG nor JPEG, or cut short.
    """
    if data.startswith(_PNG_START):
        return _read_png_header(data)
    if data.startswith(_JPEG_START):
        return _read_jpeg_header(data)
    raise ValueError("it begins neither as JPEG nor as PNG")


def _read_png_header(data: bytes) -> ImageHeader:
    """Walk over the chunks: length, kind, contents, checksum."""
    size_wh, orientation, position = None, 1, len(_PNG_START)
    while size_wh is None or data[position + 4 : position + 8] != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, position)
        if kind == b"IHDR":
            size_wh = struct.unpack_from(">II", data, position + 8)
        elif kind == b"eXIf":
            orientation = _orientation(data[position + 8 : position + 8 + length])
        position += 12 + length
    return ImageHeader(size_wh, orientation)


def _read_jpeg_header(data: bytes) -> ImageHeader:
    """Walk over the segments, marker, length and contents, up to the scan, where the pixels begin."""
    size_wh, orientation, restarts, position = None, 1, False, 2
    while data[position + 1] != _SCAN_MARKER:
        lead, marker = data[position : position + 2]
        if lead != 0xFF:
            raise ValueError("its segments do not follow each other")
        if marker == 0xFF or marker in _LONE_MARKERS:
            position += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", data, position + 2)
        content = data[position + 4 : position + 2 + length]
        if marker in _SIZE_MARKERS:
            height, width = struct.unpack_from(">HH", content, 1)
            size_wh = (width, height)
        elif marker == _EXIF_MARKER and content.startswith(_EXIF_START):
            orientation = _orientation(content[len(_EXIF_START) :])
        elif marker == _RESTART_INTERVAL_MARKER:
            restarts = any(content)
        position += 2 + length
    if size_wh is None:
        raise ValueError("its size is missing")
    # OpenCV would give a part of a picture that breaks off, or a wrong one.
    check_scans(data, position, restarts)
    return ImageHeader(size_wh, orientation, is_jpeg=True)


def _orientation(tiff: bytes) -> int:
    """Find the orientation in EXIF data, a row of entries (tag, type, count, value); 1 where there is none.

    Damaged data count as none, as for OpenCV and viewers.
    """
    order = "<" if tiff.startswith(b"II") else ">"
    try:
        (start,) = struct.unpack_from(f"{order}I", tiff, 4)
        (count,) = struct.unpack_from(f"{order}H", tiff, start)
        for entry in range(start + 2, start + 2 + 12 * count, 12):
            tag, _, _, value = struct.unpack_from(f"{order}HHIH", tiff, entry)
            if tag == _ORIENTATION_TAG:
                return value if 1 <= value <= 8 else 1
    except struct.error:
        pass
    return 1
