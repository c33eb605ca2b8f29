"""Cut a picture out of an image, bilinearly, at places rounded to 1/32 of a pixel.

MediaPipe's networks are fed so by OpenCV 3 and 4; OpenCV 5 interpolates at the exact places, which moves key
points by a tenth of a pixel. Here all versions do the same.
"""

import cv2
import numpy as np

from poem_jax.typing import Array, Float, UInt8

_BITS = 5
_STEPS = 1 << _BITS
_MAX_PLACE = 2**15 - 1


def cut_picture(
    image: UInt8[Array, "h w 3"], image_from_picture: Float[Array, "2 3"], size: int, *, border: int
) -> UInt8[Array, "size size 3"]:
    """Return a square picture.

    Args:
        image: Up to 32767 pixels long and wide.
        image_from_picture: Moves a pixel's number (column, row) in the picture to its number in the image.
        size: Of the picture, pixels.
        border: What lies beyond the image: `cv2.BORDER_CONSTANT` for zeros, or `cv2.BORDER_REPLICATE`.
    """
    columns, rows = np.meshgrid(np.arange(size), np.arange(size))
    places = np.stack([columns, rows, np.ones_like(rows)], -1) @ image_from_picture.T
    steps = np.rint(np.clip(places, -_MAX_PLACE, _MAX_PLACE) * _STEPS).astype(np.int64)
    whole, part = steps >> _BITS, steps & (_STEPS - 1)
    shares = part[..., 1] * _STEPS + part[..., 0]
    return cv2.remap(
        image, whole.astype(np.int16), shares.astype(np.uint16), cv2.INTER_LINEAR, borderMode=border
    )
