"""The lens of a rig's camera: between raw, distorted photographs and ideal pinhole pictures.

"Ideal" pixels are those that the same `K` would see through a lens without distortion. A picture of any
pinhole at the camera's place is sampled straight from the photograph, by one interpolation: pixel centre ->
ray -> distortion -> raw pixel.
"""

from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.geometry.cameras import (
    normalised_from_pixels,
    pixel_centres,
    pixels_from_normalised,
    resize_intrinsics,
)
from poem_jax.geometry.distortion import distort, distort_pixels, undistort, undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import transform_points
from poem_jax.typing import Array, Bool, Float, UInt8

_MAX_SUPERSAMPLE = 8
_ROUND_TRIP_TOLERANCE = 1e-3
_MISSED_PX = 0.5
_NEAR = 1e-3
_FAR_OUTSIDE = 1e3
_NODE_STEP = 4
"""Picture pixels between the rays that are tried on the lens."""


def project_raw(
    rig: Rig, view: int, points_world: Float[Array, "point 3"]
) -> tuple[Float[Array, "point 2"], Float[Array, "point 3"]]:
    """Project world points into a raw photograph.

    Returns:
        Raw pixels, and the points in the camera's frame. Pixels are NaN for points behind the camera and for
        those so far off the axis that the distortion polynomial turns back, or beyond `WIDEST_ANGLE` of a
        fisheye: the lens does not show them.
    """
    K, dist = rig.K[view], rig.dist[view]
    points_cam = transform_points(rig.T_cam_from_world[view], np.asarray(points_world, np.float64))
    in_front = points_cam[:, 2] > _NEAR
    rays = points_cam[:, :2] / np.where(in_front, points_cam[:, 2], 1.0)[:, None]
    bent = distort(rays, dist)
    shown = in_front & _shows(dist, rays, bent)
    return np.where(shown[:, None], pixels_from_normalised(K, bent), np.nan), points_cam


def ideal_pixels(
    uv_px: Float[Array, "point 2"], K: Float[Array, "3 3"], dist: Float[Array, " term"]
) -> Float[Array, "point 2"]:
    """Return where the same K without a lens sees pixels of a photograph; NaN where its lens has no ray."""
    ideal = undistort_pixels(uv_px, K, dist)
    missed = np.linalg.norm(distort_pixels(ideal, K, dist) - uv_px, axis=-1, keepdims=True)
    return np.where(missed < _MISSED_PX, ideal, np.nan)


def _shows(
    dist: Float[Array, " term"], rays: Float[Array, "point 2"], bent: Float[Array, "point 2"]
) -> Bool[Array, " point"]:
    """Tell which rays come back from where the lens images them; beyond its fold none do."""
    return np.linalg.norm(undistort(bent, dist) - rays, axis=-1) < _ROUND_TRIP_TOLERANCE


class PictureMap(NamedTuple):
    """Where in a photograph every sample of a picture lies; made once per camera and picture."""

    columns: Float[Array, "fine_h fine_w"]
    """Column in the photograph as OpenCV counts, from the centre of the first."""
    rows: Float[Array, "fine_h fine_w"]
    hw: tuple[int, int]
    """Size of the picture; it has a whole number of samples per pixel and axis."""


def picture_map(
    K: Float[Array, "3 3"],
    dist: Float[Array, " term"],
    K_picture: Float[Array, "3 3"],
    hw: tuple[int, int],
    step: float,
    R_cam_from_picture: Float[Array, "3 3"] | None = None,
) -> PictureMap:
    """Prepare to see what a pinhole with `K_picture` sees from the place of a camera.

    Samples that the lens does not show, as their rays lie beyond its fold, are put far outside.

    Args:
        K: Intrinsics of the photographs.
        dist: Their lens, the terms of `geometry.distortion`.
        K_picture: Intrinsics of the picture wanted.
        hw: Size of the picture wanted.
        step: Raw pixels per picture pixel; above 1 several samples per pixel are averaged, as otherwise
            detail aliases.
        R_cam_from_picture: Where the pinhole looks, if not along the camera's own axis.
    """
    samples = int(np.clip(np.ceil(step), 1, _MAX_SUPERSAMPLE))
    fine_hw = (hw[0] * samples, hw[1] * samples)
    rays = _picture_rays(resize_intrinsics(K_picture, hw, fine_hw), fine_hw, R_cam_from_picture)
    raw_px = pixels_from_normalised(K, distort(rays, dist)).reshape(*fine_hw, 2)
    if dist.any():
        # The round trip costs as much as a crop, so it is made for few rays; doubtful samples are left out.
        node_hw = (-(-hw[0] // _NODE_STEP), -(-hw[1] // _NODE_STEP))
        nodes = _picture_rays(resize_intrinsics(K_picture, hw, node_hw), node_hw, R_cam_from_picture)
        shown = _shows(dist, nodes, distort(nodes, dist)).reshape(node_hw).astype(np.float32)
        raw_px[cv2.resize(shown, fine_hw[::-1], interpolation=cv2.INTER_LINEAR) < 1 - 1e-6] = -_FAR_OUTSIDE
    index = (raw_px - 0.5).astype(np.float32)
    return PictureMap(np.ascontiguousarray(index[..., 0]), np.ascontiguousarray(index[..., 1]), hw)


def _picture_rays(
    K_picture: Float[Array, "3 3"], hw: tuple[int, int], R_cam_from_picture: Float[Array, "3 3"] | None
) -> Float[Array, "point 2"]:
    """Return where the pixels of a picture look, on the camera's normalised image plane."""
    rays = normalised_from_pixels(K_picture, pixel_centres(hw, np.float64).reshape(-1, 2))
    return rays if R_cam_from_picture is None else _turned(rays, R_cam_from_picture)


def _turned(
    rays_picture: Float[Array, "point 2"], R_cam_from_picture: Float[Array, "3 3"]
) -> Float[Array, "point 2"]:
    """Turn normalised points; what comes to lie beside or behind the camera goes far outside its image."""
    rays = np.concatenate([rays_picture, np.ones_like(rays_picture[:, :1])], axis=-1) @ R_cam_from_picture.T
    ahead = rays[:, 2:] > _NEAR
    return np.where(ahead, rays[:, :2] / np.where(ahead, rays[:, 2:], 1.0), _FAR_OUTSIDE)


def take_picture(image: UInt8[Array, "h w 3"], where: PictureMap) -> UInt8[Array, "h2 w2 3"]:
    """Sample a photograph; what lies beyond it is black."""
    fine = cv2.remap(image, where.columns, where.rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    if fine.shape[:2] == where.hw:
        return fine
    return cv2.resize(fine, where.hw[::-1], interpolation=cv2.INTER_AREA)


def stored_picture_map(
    K: Float[Array, "3 3"],
    dist: Float[Array, " term"] | None,
    mirror_px: float | None,
    K_picture: Float[Array, "3 3"],
    hw: tuple[int, int],
    step: float,
) -> PictureMap:
    """Prepare to see what a view of a `data.frames.MultiViewFrame` shows, from its image as stored.

    Args:
        K: Of the view, after its mirror.
        dist: Lens of the stored image; None = it has none.
        mirror_px: Column about which the stored image is to be turned left to right; None = it is not.
        K_picture: Of the picture wanted; an affine change H of the view's ideal image has H @ K.
        hw: Its size.
        step: Pixels of the image per picture pixel, as for `picture_map`.
    """
    K_stored = np.array(K, np.float64)
    dist = np.zeros(5) if dist is None else np.asarray(dist, np.float64)
    if mirror_px is None:
        return picture_map(K_stored, dist, np.asarray(K_picture, np.float64), hw, step)
    # K of the stored image is M K D, with M the turn of pixels, D = diag(-1, 1, 1) that of rays.
    K_stored[0, 1] = -K_stored[0, 1]
    K_stored[0, 2] = 2 * mirror_px - K_stored[0, 2]
    return picture_map(K_stored, dist, np.asarray(K_picture, np.float64) * [-1, 1, 1], hw, step)
