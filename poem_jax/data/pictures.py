"""Encoded images to RGB arrays, and the one warp that makes a crop of each.

Two decoders. OpenCV's is the default. `simplejpeg` (the extra `turbo`), made on libjpeg-turbo, can also
shrink while it decodes, to M/8 of the size, exactly: 8 pixels become M. It refuses a JPEG whose data do not
end where they should, which OpenCV only prints; a flipped bit that leaves a readable JPEG neither can see.

Both give the pixels that the calibration belongs to, by the rules of `io/images.py`.
"""

import importlib
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.data.frames import EncodedImage
from poem_jax.geometry.cameras import index_homography
from poem_jax.io.images import ImageHeader, decode_stored, is_to_be_turned, read_header, turn
from poem_jax.typing import Array, Float, Int, UInt8

EIGHTHS = 8
"""An image at its own size."""


class Decoder(NamedTuple):
    """How bytes become pixels; `decoder(name)` chooses."""

    name: str
    decode_stored: Callable[[bytes, ImageHeader, str, int], UInt8[Array, "h w 3"]]
    """Of data, header, name and eighths of the size: RGB as stored, without any turn."""
    shrinks: bool
    """Whether it can decode JPEGs at less than `EIGHTHS`."""


class Picture(NamedTuple):
    """A decoded image."""

    rgb: UInt8[Array, "h w 3"]
    scale: float
    """Its pixels are those of the stored image, about (0, 0), times this."""


def decoder(name: str) -> Decoder:
    """Return the decoder "opencv" or "turbo".

    Raises: ValueError: another name. ModuleNotFoundError: "turbo" without simplejpeg.
    """
    if name == OPENCV.name:
        return OPENCV
    if name != "turbo":
        raise ValueError(f'a decoder is "opencv" or "turbo"; got {name!r}')
    try:
        importlib.import_module("simplejpeg")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'the decoder "turbo" needs simplejpeg, which is not installed: '
            'pip install "poem-jax[turbo]", or use the decoder "opencv"'
        ) from error
    return Decoder("turbo", _decode_turbo, shrinks=True)


def decode(
    image: EncodedImage, size_wh: Int[Array, "2"] | tuple[int, int], using: Decoder | None = None
) -> UInt8[Array, "h w 3"]:
    """Decode to RGB at the size for which the camera was calibrated.

    Args:
        image: JPEG or PNG.
        size_wh: as calibrated; the image must have it, as stored or as its EXIF orientation shows it.
        using: None = OpenCV.

    Raises: ValueError: it is damaged, or of another size; the message begins with the image's name.
    """
    return decode_shrunk(image, size_wh, EIGHTHS, using).rgb


def decode_shrunk(
    image: EncodedImage,
    size_wh: Int[Array, "2"] | tuple[int, int],
    eighths: int,
    using: Decoder | None = None,
) -> Picture:
    """Decode like `decode`, at `eighths` / 8 of the size where the decoder and the image allow it.

    PNGs and turned images keep their size.
    """
    using = using or OPENCV
    header = read_header(image.data, image.name)
    turned = is_to_be_turned(header, (int(size_wh[0]), int(size_wh[1])), image.name)
    shrinks = using.shrinks and header.is_jpeg and not turned
    eighths = eighths if shrinks else EIGHTHS
    rgb = using.decode_stored(image.data, header, image.name, eighths)
    return Picture(turn(rgb, header.orientation) if turned else rgb, eighths / EIGHTHS)


def eighths_for(scale: float) -> int:
    """Return the smallest eighths of an image that is to be shrunk by `scale` (output over input) and must
    not be enlarged after it was decoded."""
    return int(np.clip(np.ceil(EIGHTHS * scale), 1, EIGHTHS))


def warp(
    picture: Picture,
    H_out_from_image: Float[Array, "3 3"],
    out_hw: tuple[int, int],
    mirror_px: float | None = None,
) -> UInt8[Array, "h w 3"]:
    """Return the picture under an affine map, interpolated between four pixels, black beyond its edge.

    Args:
        picture: its full-size pixels are those that `H_out_from_image` maps, after the mirror.
        H_out_from_image: affine, pixels where images span [0, W] x [0, H].
        out_hw: height and width of the output.
        mirror_px: turn the picture left to right about this column first, u' = 2 mirror_px - u.
    """
    H = H_out_from_image @ _stretch(1 / picture.scale)
    if mirror_px is not None:
        H = H_out_from_image @ mirror_about(mirror_px) @ _stretch(1 / picture.scale)
    return cv2.warpAffine(picture.rgb, index_homography(H)[:2], out_hw[::-1], flags=cv2.INTER_LINEAR)


def mirror_about(column_px: float) -> Float[Array, "3 3"]:
    """Return the map u' = 2 column - u, v' = v."""
    return np.array([[-1, 0, 2 * float(column_px)], [0, 1, 0], [0, 0, 1]], np.float64)


def apply_gains(image: UInt8[Array, "h w 3"], gains: Float[Array, "3"]) -> UInt8[Array, "h w 3"]:
    """Multiply the channels, hold them to 0..255 and truncate to whole numbers, as the releases do."""
    table = np.clip(np.arange(256)[:, None] * gains, 0, 255).astype(np.uint8)
    return cv2.LUT(image, table[None])


def _stretch(scale: float) -> Float[Array, "3 3"]:
    return np.diag([scale, scale, 1.0])


def _decode_opencv(data: bytes, header: ImageHeader, name: str, eighths: int) -> UInt8[Array, "h w 3"]:
    return decode_stored(data, header, name)


def _decode_turbo(data: bytes, header: ImageHeader, name: str, eighths: int) -> UInt8[Array, "h w 3"]:
    if not header.is_jpeg:
        return decode_stored(data, header, name)
    simplejpeg = importlib.import_module("simplejpeg")
    width, height = (-(-side * eighths // EIGHTHS) for side in header.size_wh)
    least = {} if eighths == EIGHTHS else {"min_width": width, "min_height": height}
    try:
        rgb = simplejpeg.decode_jpeg(data, colorspace="RGB", strict=True, **least)
    except ValueError as error:
        raise ValueError(f"{name} cannot be read as an image ({len(data)} bytes): {error}") from error
    if rgb.shape != (height, width, 3):
        raise ValueError(f"{name} is {width} x {height} by its header, but decodes to {rgb.shape[1::-1]}")
    return rgb


OPENCV = Decoder("opencv", _decode_opencv, shrinks=False)
"""The default."""
