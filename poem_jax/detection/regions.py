"""Regions of an image in which a hand is looked for: turned squares, the fingers up.

A region comes from a palm, or in a video from the hand's key points in the frame before.
"""

from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.detection.landmark_network import INPUT_SIZE
from poem_jax.detection.palms import Palm
from poem_jax.detection.pictures import cut_picture
from poem_jax.hand.topology import FINGER_JOINTS, WRIST
from poem_jax.typing import Array, Float, UInt8

_INDEX_KNUCKLE, _MIDDLE_KNUCKLE, _RING_KNUCKLE = (FINGER_JOINTS[finger][0] for finger in (1, 2, 3))
_PALM_SIZE, _PALM_SHIFT = 2.6, -0.5
"""Side of a region over the longer side of a palm's box; how far it moves along the hand, over the box."""
_HAND_SIZE, _HAND_SHIFT = 2.0, -0.1
"""The same over the box of key points in the frame before."""
_HAND_POINTS = [0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18]
"""The key points that move little when fingers bend."""


class Region(NamedTuple):
    """A square in an image, in pixels; the image spans [0, W] x [0, H]."""

    center: Float[Array, "2"]
    side: float
    turn: float
    """Radians, clockwise as seen in the image: by how much the hand is turned from fingers up."""

    @property
    def axes(self) -> Float[Array, "2 2"]:
        """The square's right and its down, as columns."""
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        return np.array([[cos, -sin], [sin, cos]])


def region_of_palm(palm: Palm) -> Region:
    """Return the region about a palm in which the whole hand lies."""
    turn = _turn(palm.points[2] - palm.points[0])
    low, high = palm.box[:2], palm.box[2:]
    return _widened((low + high) / 2, high - low, turn, _PALM_SIZE, _PALM_SHIFT)


def region_of_hand(keypoints_px: Float[Array, "21 2"]) -> Region:
    """Return the region about a hand in which it lies in the next frame, too."""
    knuckles = keypoints_px[[_INDEX_KNUCKLE, _RING_KNUCKLE]].mean(0) / 2 + keypoints_px[_MIDDLE_KNUCKLE] / 2
    turn = _turn(knuckles - keypoints_px[WRIST])
    axes = Region(np.zeros(2), 1.0, turn).axes
    along = keypoints_px[_HAND_POINTS] @ axes
    low, high = along.min(0), along.max(0)
    return _widened(axes @ ((low + high) / 2), high - low, turn, _HAND_SIZE, _HAND_SHIFT)


def cut_out(image: UInt8[Array, "h w 3"], region: Region) -> UInt8[Array, "224 224 3"]:
    """Return the picture of a region for the landmark network; beyond the image its border goes on."""
    axes = region.axes * (region.side / INPUT_SIZE)
    place = np.column_stack([axes, region.center - axes @ np.full(2, INPUT_SIZE / 2)])
    return cut_picture(image, place, INPUT_SIZE, border=cv2.BORDER_REPLICATE)


def into_image(points: Float[Array, "point 2"], region: Region) -> Float[Array, "point 2"]:
    """Move points from the picture of a region, which spans [0, 224] x [0, 224], into the image."""
    return region.center + (points / INPUT_SIZE - 0.5) * region.side @ region.axes.T


def overlap(a: Region, b: Region) -> float:
    """Return intersection over union of two regions, their turns left out."""
    shared = np.clip((a.side + b.side) / 2 - np.abs(a.center - b.center), 0, min(a.side, b.side)).prod()
    return float(shared / (a.side**2 + b.side**2 - shared))


def _turn(up: Float[Array, "2"]) -> float:
    """Return by how much a direction is turned from the image's up, in [-pi, pi)."""
    turn = np.pi / 2 - np.arctan2(-up[1], up[0])
    return float((turn + np.pi) % (2 * np.pi) - np.pi)


def _widened(
    center: Float[Array, "2"], size: Float[Array, "2"], turn: float, ratio: float, shift: float
) -> Region:
    """Return the square over a box's longer side, moved along the hand by a share of the box's height."""
    region = Region(center, float(size.max()) * ratio, turn)
    return region._replace(center=center + region.axes[:, 1] * (shift * size[1]))
