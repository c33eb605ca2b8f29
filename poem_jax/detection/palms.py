"""Palms in an image: what the palm network's guesses say.

The image is set into a square with zeros around it, and shrunk to the network's input; a guess is relative to
its anchor, the centre of a cell. Guesses that overlap are merged by weighted suppression (Bazarevsky et al.
2019, "BlazeFace", section 3.4): their boxes and points are averaged by score.
"""

from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.detection.palm_network import GUESS_SIZE, INPUT_SIZE
from poem_jax.detection.pictures import cut_picture
from poem_jax.typing import Array, Float, UInt8

MIN_SCORE = 0.5
"""A guess counts from here on."""
_MAX_LOGIT = 100.0
_MERGED_OVERLAP = 0.3
"""Intersection over union above which two guesses are of one palm."""
_GRIDS = ((24, 2), (12, 6))
"""Cells along a side, and guesses a cell."""


class Palm(NamedTuple):
    """A palm in an image, in pixels; the image spans [0, W] x [0, H]."""

    box: Float[Array, "4"]
    """(x0, y0, x1, y1)"""
    points: Float[Array, "7 2"]
    """The wrist, knuckles of index, middle, ring and little finger, then two of the thumb."""
    score: float


def letterbox(image: UInt8[Array, "h w 3"]) -> UInt8[Array, "192 192 3"]:
    """Set an image into the middle of a square of zeros, and shrink that to the network's input."""
    scale, corner = _square(image.shape[0], image.shape[1])
    place = np.array([[scale, 0, corner[0]], [0, scale, corner[1]]])
    return cut_picture(image, place, INPUT_SIZE, border=cv2.BORDER_CONSTANT)


def find_palms(
    logits: Float[Array, "2016"], guesses: Float[Array, "2016 18"], image_hw: tuple[int, int]
) -> list[Palm]:
    """Return the palms that the network's guesses for an image show, the surest first."""
    scores = 1 / (1 + np.exp(-np.clip(logits.astype(float), -_MAX_LOGIT, _MAX_LOGIT)))
    chosen = np.flatnonzero(scores >= MIN_SCORE)
    chosen = chosen[np.argsort(-scores[chosen], kind="stable")]
    scale, corner = _square(*image_hw)
    values = guesses[chosen].astype(float).reshape(-1, GUESS_SIZE // 2, 2)
    anchors = _anchors()[chosen]
    center, size = values[:, 0] + anchors, values[:, 1]
    points = np.concatenate(
        [(center - size / 2)[:, None], (center + size / 2)[:, None], values[:, 2:] + anchors[:, None]], axis=1
    )
    return _merged(points * scale + corner, scores[chosen])


def _square(height: int, width: int) -> tuple[float, Float[Array, "2"]]:
    """Return image pixels per pixel of the input, and where the square's corner lies in the image."""
    side = max(height, width)
    return side / INPUT_SIZE, np.array([(width - side) / 2, (height - side) / 2])


def _anchors() -> Float[Array, "2016 2"]:
    """Return the centres of the guesses' cells, in pixels of the input."""
    grids = []
    for cells, guesses in _GRIDS:
        y, x = np.mgrid[:cells, :cells].reshape(2, -1)
        grids.append(np.repeat((np.stack([x, y], -1) + 0.5) * (INPUT_SIZE / cells), guesses, axis=0))
    return np.concatenate(grids)


def _merged(points: Float[Array, "guess 9 2"], scores: Float[Array, "guess"]) -> list[Palm]:
    """Merge guesses that overlap the surest one; then those of the rest, until none is left."""
    palms = []
    while len(scores):
        same = _overlap(points[0, :2], points[:, :2]) > _MERGED_OVERLAP
        same[0] = True
        mean = np.average(points[same], axis=0, weights=scores[same])
        palms.append(Palm(mean[:2].reshape(4), mean[2:], float(scores[0])))
        points, scores = points[~same], scores[~same]
    return palms


def _overlap(box: Float[Array, "2 2"], others: Float[Array, "other 2 2"]) -> Float[Array, "other"]:
    """Return intersection over union of a box with others; corners are (low, high)."""
    shared = np.clip(np.minimum(box[1], others[:, 1]) - np.maximum(box[0], others[:, 0]), 0, None).prod(-1)
    areas = (box[1] - box[0]).prod() + (others[:, 1] - others[:, 0]).prod(-1) - shared
    return np.where(areas > 0, shared / np.where(areas > 0, areas, 1), 0)
