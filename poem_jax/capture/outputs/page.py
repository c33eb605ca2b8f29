"""What the 3D page shows of a take: frames thinned out evenly, with small undistorted pictures."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from poem_jax.data.lens import PictureMap, picture_map
from poem_jax.geometry.distortion import undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import rigid, smallest_rotation
from poem_jax.viz.page import PageCamera, PageFrame

PAGE_FRAMES = 120
"""A take with more frames that hold a hand is thinned out evenly for the page."""
LONG_TAKE = 20
"""Frames beyond which overlays become videos."""
_PAGE_PIXELS = 14e6
"""Of all pictures of a page together: as JPEG they take 2 to 3 MB, in the page 3 to 4."""
_LEAST_PICTURE_PX, _LARGEST_PICTURE_PX = 160, 640
"""Longer side of a page's picture."""
_PICTURE_SAMPLES = 3.0
"""Along each axis of a picture's pixel at most: the maps of eight large cameras stay below 150 MB."""


class Gallery(NamedTuple):
    """The small ideal cameras whose pictures the page shows at the places of a rig's cameras."""

    cameras: list[PageCamera]
    maps: list[PictureMap]


def make_gallery(rig: Rig, num_frames: int | None) -> Gallery:
    """Prepare the page's pictures; those of a take that is long, or may be (None), are smaller."""
    longer = picture_sides(rig, num_frames)
    pairs = [_page_camera(rig, view, longer[view]) for view in range(rig.num_views)]
    return Gallery([camera for camera, _ in pairs], [where for _, where in pairs])


def picture_sides(rig: Rig, num_frames: int | None) -> list[int]:
    """Return the longer side of each camera's pictures: all of a page together have `_PAGE_PIXELS`, but none
    is larger than its photograph, nor than a page can use, nor smaller than is worth looking at."""
    frames = PAGE_FRAMES if not num_frames else min(num_frames, PAGE_FRAMES)
    shorter, longer = np.sort(rig.size_wh, axis=-1).T
    wanted = np.sqrt(_PAGE_PIXELS / (frames * rig.num_views) * longer / shorter)
    wanted = np.minimum(np.clip(wanted, _LEAST_PICTURE_PX, _LARGEST_PICTURE_PX), longer)
    return [int(side) for side in wanted]


def is_long(num_frames: int | None) -> bool:
    """Tell whether a take is long, or may be (None)."""
    return num_frames is None or num_frames > LONG_TAKE


class PageFrames:
    """The frames of a page, gathered while a take goes by: those with a hand, thinned out evenly."""

    def __init__(self) -> None:
        self.kept: list[PageFrame] = []
        self._every = 1
        self._offered = 0

    def offer(self, make: Callable[[], PageFrame]) -> None:
        """Count a frame that holds a hand; make and keep it if its turn has come."""
        if self._offered % self._every == 0:
            self.kept.append(make())
        self._offered += 1
        if len(self.kept) > PAGE_FRAMES:
            self.kept = self.kept[::2]
            self._every *= 2


def _page_camera(rig: Rig, view: int, longer: int) -> tuple[PageCamera, PictureMap]:
    """Make a pinhole with a central axis that looks at the middle of a photograph, whose own axis may not."""
    K, dist = rig.K[view], rig.dist[view]
    width, height = (int(size) for size in rig.size_wh[view])
    x, y = undistort_pixels(np.array([[width / 2, height / 2]]), K, dist)[0]
    ray = np.array([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], 1.0])
    R_cam_from_picture = smallest_rotation(np.array([0.0, 0.0, 1.0]), ray)
    scale = longer / max(width, height)
    # Off its axis an image is stretched by the squared length of the ray.
    focal_px = float(scale * (K[0, 0] + K[1, 1]) / 2 * (ray @ ray))
    hw = (round(scale * height), round(scale * width))
    K_picture = np.array([[focal_px, 0, hw[1] / 2], [0, focal_px, hw[0] / 2], [0, 0, 1]])
    T_picture_from_world = rigid(R_cam_from_picture.T, np.zeros(3)) @ rig.T_cam_from_world[view]
    where = picture_map(K, dist, K_picture, hw, min(1 / scale, _PICTURE_SAMPLES), R_cam_from_picture)
    return PageCamera(rig.names[view], T_picture_from_world, focal_px, hw), where
