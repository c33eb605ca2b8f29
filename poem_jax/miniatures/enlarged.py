"""Planted frames for cameras of many megapixels: drawn small, then shown and labelled at full size.

Rendering a hand in eight pictures of 2800 x 2000 takes ten seconds. A picture of a fifth of the size,
enlarged, is the picture of the camera whose intrinsics are enlarged with it, exactly.
"""

import cv2
import numpy as np

from poem_jax.miniatures.scene import PlantedFrame
from poem_jax.typing import Array, Int, UInt8


def enlarged(frame: PlantedFrame, factor: int) -> PlantedFrame:
    """Return the frame as cameras see it that have `factor` times the pixels along both axes."""
    scale = np.diag([factor, factor, 1.0])
    sizes = frame.size_wh * factor
    return frame._replace(
        size_wh=sizes,
        K=scale @ frame.K,
        keypoints_px=frame.keypoints_px * factor,
        images=tuple(_resized(*both) for both in zip(frame.images, sizes, strict=True)),
    )


def _resized(image: UInt8[Array, "h w 3"], size_wh: Int[Array, "2"]) -> UInt8[Array, "h2 w2 3"]:
    """Return RGB that lies in memory as BGR, which OpenCV encodes without a copy."""
    bgr = np.ascontiguousarray(image[..., ::-1])
    return np.asarray(cv2.resize(bgr, size_wh.tolist(), interpolation=cv2.INTER_LINEAR), np.uint8)[..., ::-1]
