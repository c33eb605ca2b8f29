"""Crops around hands: which affine map of a view's image goes with which K and which turn of its camera.

Two sets of formulas. *Exact* ones turn the camera about its optical axis and warp the image by K Rot(a) K^-1
(paper, section "Data Augmentation"), which is true for any K. Those of *POEM's releases* (v1 and v2 alike)
turn the image by Rot(a) and pair it with K of the un-turned crop, which is true for fx = fy without skew;
otherwise key points and projections differ by

    (W / side) |sin a| |fx - fy| |(x, y)|,  x, y = normalised image coordinates of the point,

at 5 degrees, with f of DexYCB (1 % apart) and a hand 0.3 off the axis, by about 0.2 pixels.

The releases count pixels from the centre of the top-left pixel; so their crop has the box's centre half a
pixel beyond its own. Here all pixels, also these, are given where the image spans [0, W] x [0, H].
"""

from typing import NamedTuple

import numpy as np

from poem_jax.data.transforms import box_from_center, square_box
from poem_jax.geometry.cameras import crop_homography, roll, transform_pixels
from poem_jax.geometry.rig import HALF_PIXEL
from poem_jax.geometry.transforms import rotation_about_z
from poem_jax.typing import Array, Float

_SPAN_FROM_INDEX = np.array([[1, 0, HALF_PIXEL], [0, 1, HALF_PIXEL], [0, 0, 1]])
_INDEX_FROM_SPAN = np.array([[1, 0, -HALF_PIXEL], [0, 1, -HALF_PIXEL], [0, 0, 1]])
_DECIMALS = 3
"""Of a centre in pixels; what lies beyond is float32's rounding."""


class Squares(NamedTuple):
    """Square boxes around a hand, one a view, pixels."""

    center_px: Float[Array, "view 2"]
    side_px: Float[Array, " view"]

    def moved(self, shift: Float[Array, "view 2"], scale: Float[Array, " view"]) -> "Squares":
        """Move by shares of the side, then scale the side."""
        return Squares(self.center_px + shift * self.side_px[:, None], self.side_px * scale)


class Crops(NamedTuple):
    """Of every view: how pixels, intrinsics and the camera's frame change."""

    H_crop_from_image: Float[Array, "view 3 3"]
    """Affine."""
    K: Float[Array, "view 3 3"]
    """Of the crop."""
    T_turned_from_cam: Float[Array, "view 4 4"]
    """From the camera's frame to the frame that K belongs to: a turn about the optical axis."""


def exact_squares(points_px: Float[Array, "view point 2"], ratio: float) -> Squares:
    """Return squares half-way between the extremes of points, all of which count.

    Args:
        points_px: key points, or two corners of a box.
        ratio: side of the square over the longer side around the points.
    """
    box = square_box(points_px, ratio)
    return Squares((box[:, :2] + box[:, 2:]) / 2, box[:, 2] - box[:, 0])


def release_squares(points_px: Float[Array, "view point 2"], ratio: float) -> Squares:
    """Return the squares of POEM's releases: the centre, counted from the centre of the top-left pixel, is
    truncated towards zero."""
    center, side = exact_squares(points_px, ratio)
    return Squares(whole_pixels(center - HALF_PIXEL) + HALF_PIXEL, side)


def whole_pixels(center_px: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """Truncate towards zero, so that a whole number which rounding left a trace below itself stays."""
    return np.trunc(np.round(center_px, _DECIMALS))


def exact_crops(
    K: Float[Array, "view 3 3"], squares: Squares, angle: Float[Array, " view"], out_hw: tuple[int, int]
) -> Crops:
    """Turn cameras by `angle` (radians, clockwise in the image), then crop squares that moved along.

    Args:
        K: of the whole images.
        squares: in the whole images, before the turn; their side becomes the output's width.
        angle: 0 = no turn.
        out_hw: height and width of the crops.
    """
    T_turned_from_cam, H_turned_from_image = roll(K, np.broadcast_to(np.eye(4), (len(K), 4, 4)), angle)
    center = transform_pixels(H_turned_from_image, squares.center_px[:, None])[:, 0]
    H_crop_from_turned = _crop(center, squares.side_px, out_hw)
    return Crops(H_crop_from_turned @ H_turned_from_image, H_crop_from_turned @ K, T_turned_from_cam)


def release_crops(
    K: Float[Array, "view 3 3"], squares: Squares, angle: Float[Array, " view"], out_hw: tuple[int, int]
) -> Crops:
    """Do what POEM's releases do; arguments as for `exact_crops`.

    In their coordinates the image is mapped by S(R c, side) R, about the image's origin, and
    K_crop = S(o + R (c - o), side) K, with o the principal point and S(c, s) the crop of side s about c.
    """
    K_index, center = _INDEX_FROM_SPAN @ K, squares.center_px - HALF_PIXEL
    R = rotation_about_z(angle)
    optical = K_index[:, :2, 2]
    about_origin = (R[:, :2, :2] @ center[..., None])[..., 0]
    about_axis = optical + (R[:, :2, :2] @ (center - optical)[..., None])[..., 0]
    affine = _crop(about_origin, squares.side_px, out_hw) @ R
    K_crop = _SPAN_FROM_INDEX @ _crop(about_axis, squares.side_px, out_hw) @ K_index
    T_turned_from_cam = np.broadcast_to(np.eye(4), (len(K), 4, 4)).copy()
    T_turned_from_cam[:, :3, :3] = R
    return Crops(_SPAN_FROM_INDEX @ affine @ _INDEX_FROM_SPAN, K_crop, T_turned_from_cam)


def _crop(
    center: Float[Array, "view 2"], side: Float[Array, " view"], out_hw: tuple[int, int]
) -> Float[Array, "view 3 3"]:
    """Return S(c, s): c goes to the middle of the output, s becomes its width; the same scale downwards."""
    box = box_from_center(center, side)
    rise = side * (out_hw[0] / out_hw[1] - 1) / 2
    return crop_homography(box + rise[:, None] * [0, -1, 0, 1], out_hw)
