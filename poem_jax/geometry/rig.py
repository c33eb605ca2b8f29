"""`Rig`: the calibrated cameras of a capture, as its files hold them, before any crop; NumPy only."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from poem_jax.geometry.cameras import Cameras
from poem_jax.geometry.distortion import is_fisheye
from poem_jax.typing import Array, Bool, Float, Int

HALF_PIXEL = 0.5
"""From coordinates that count from the centre of the top-left pixel, as OpenCV and detectors do, to those in
which the image spans [0, W] x [0, H]: added to pixels that come from a file, subtracted where they go into
one."""


class Rig(NamedTuple):
    """Cameras of a capture in metres and in pixels where the image spans [0, W] x [0, H].

    Files that count pixels from a pixel's centre, or lengths in another unit, are converted where they are
    read.
    """

    names: tuple[str, ...]
    size_wh: Int[Array, "view 2"]
    """Width and height of the raw images."""
    K: Float[Array, "view 3 3"]
    """Intrinsics of the raw images."""
    dist: Float[Array, "view term"]
    """The lenses, as `geometry.distortion` describes; zeros for undistorted images."""
    T_cam_from_world: Float[Array, "view 4 4"]

    @property
    def num_views(self) -> int:
        """Number of cameras."""
        return len(self.names)

    @property
    def cameras(self) -> Cameras:
        """The cameras of the undistorted, uncropped images."""
        return Cameras(self.K, self.T_cam_from_world)

    @property
    def fisheye(self) -> Bool[Array, " view"]:
        """Which cameras have a fisheye; the others are pinholes with or without distortion."""
        return is_fisheye(self.dist)

    def select(self, names: Sequence[str]) -> "Rig":
        """Return the rig of the named cameras, in the given order.

        Raises: ValueError: a name is not a camera of this rig.
        """
        unknown = [name for name in names if name not in self.names]
        if unknown:
            raise ValueError(f"cameras must be among {list(self.names)}; got {unknown}")
        index = np.asarray([self.names.index(name) for name in names], dtype=int)
        return Rig(tuple(names), *(array[index] for array in self[1:]))
