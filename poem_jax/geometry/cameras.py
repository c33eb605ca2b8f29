"""Pinhole cameras: the `Cameras` pytree and the pure functions on `K` and `T_cam_from_world`.

Frames: OpenCV camera axes, x right, y down, z forward, metres. Pixels: u right, v down; the image spans
[0, W] x [0, H] and the centre of column j, row i is (j + 0.5, i + 0.5). `K = [[fx, s, cx], [0, fy, cy], [0,
0, 1]]` belongs to the image as fed. A homography `H_b_from_a` (*batch, 3, 3) maps pixels of image a to pixels
of image b. All functions follow the type of their arrays and broadcast over leading axes.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.geometry.transforms import (
    invert_rigid,
    matmul,
    rigid,
    rotation_about_z,
    transform_points,
    transpose,
)
from poem_jax.typing import Array, Bool, Float, Int, array_namespace

MIN_DEPTH = 1e-4
"""Metres. Projections divide by no smaller depth; its sign is kept, so that what lies behind a camera is seen
mirrored, and a test of the depth tells it."""
MIN_DEPTH_AHEAD = 1e-2
"""Metres. `projection_jacobian`, on which solvers descend, counts all that is nearer, or behind, as this far
ahead: it leads back before the camera, with slopes that stay finite."""


class _CameraFields(NamedTuple):
    K: Float[Array, "*batch view 3 3"]
    T_cam_from_world: Float[Array, "*batch view 4 4"]
    view_mask: Bool[Array, "*batch view"]


class Cameras(_CameraFields):
    """The calibrated views of a batch.

    `K` belongs to the image as fed, in pixels where the image spans [0, W] x [0, H];
    `T_cam_from_world` maps world points in metres to OpenCV camera axes (x right, y down, z forward);
    `view_mask` is True for views that exist (default: all). The first valid view is the primary camera.
    """

    __slots__ = ()

    def __new__(cls, K: Array, T_cam_from_world: Array, view_mask: Array | None = None) -> "Cameras":
        """Take the three arrays; without `view_mask` every view is valid."""
        # A tree map may rebuild this with leaves that are not arrays: only fill in a mask for real arrays.
        if view_mask is None and hasattr(K, "shape"):
            view_mask = np.ones(K.shape[:-2], dtype=bool)
        return super().__new__(cls, K, T_cam_from_world, view_mask)


def project(
    K: Float[Array, "*#batch 3 3"],
    T_cam_from_world: Float[Array, "*#batch 4 4"],
    points_world: Float[Array, "*#batch point 3"],
) -> tuple[Float[Array, "*#batch point 2"], Float[Array, "*#batch point"]]:
    """Project world points into an image.

    Returns: pixels, and the depth along the optical axis in metres (negative behind the camera). Pixels of
    points within `MIN_DEPTH` of the camera's plane, or behind it, are finite but mean nothing: test the
    depth.
    """
    points_cam = transform_points(T_cam_from_world, points_world)
    return project_cam(K, points_cam), points_cam[..., 2]


def project_cam(
    K: Float[Array, "*#batch 3 3"], points_cam: Float[Array, "*#batch point 3"]
) -> Float[Array, "*#batch point 2"]:
    """Project points of the camera's own frame to pixels; see `project`."""
    return pixels_from_normalised(K, points_cam[..., :2] / _safe_depth(points_cam[..., 2:]))


def projection_jacobian(
    K: Float[Array, "*#batch view 3 3"],
    T_cam_from_world: Float[Array, "*#batch view 4 4"],
    points_world: Float[Array, "*#batch joint 3"],
) -> tuple[Float[Array, "*batch view joint 2"], Float[Array, "*batch view joint 2 3"]]:
    """Return the pixels of world points in every view, and their derivative by the points.

    d (u, v) / d X = K_2x2 [R_xy - (x, y)/z R_z] / z (Hartley and Zisserman, section 6.2), with z at least
    `MIN_DEPTH_AHEAD`.
    """
    xp = array_namespace(K, T_cam_from_world, points_world)
    points_cam = transform_points(T_cam_from_world, points_world[..., None, :, :])
    depth = xp.maximum(points_cam[..., 2:], MIN_DEPTH_AHEAD)
    xy = points_cam[..., :2] / depth
    R = T_cam_from_world[..., None, :3, :3]
    slope = (R[..., :2, :] - xy[..., None] * R[..., 2:, :]) / depth[..., None]
    focal = K[..., None, :2, :2]
    pixels = xp.sum(focal * xy[..., None, :], -1) + K[..., None, :2, 2]
    # Both terms written out: of their sum over an axis jaxlib 0.10.2 makes a product, which ends the process
    # on a CPU where hands are mapped over.
    jacobian = focal[..., :1] * slope[..., None, 0, :] + focal[..., 1:] * slope[..., None, 1, :]
    return pixels, jacobian


def unproject(
    K: Float[Array, "*#batch 3 3"],
    T_cam_from_world: Float[Array, "*#batch 4 4"],
    uv_px: Float[Array, "*#batch point 2"],
    depth: Float[Array, "*#batch point"],
) -> Float[Array, "*#batch point 3"]:
    """Return the world points seen at pixels `uv_px` at a depth in metres along the optical axis."""
    xp = array_namespace(K, T_cam_from_world, uv_px, depth)
    xy = normalised_from_pixels(K, uv_px) * depth[..., None]
    points_cam = xp.concatenate([xy, xp.broadcast_to(depth[..., None], (*xy.shape[:-1], 1))], axis=-1)
    return transform_points(invert_rigid(T_cam_from_world), points_cam)


def pixels_from_normalised(
    K: Float[Array, "*#batch 3 3"], points_norm: Float[Array, "*#batch point 2"]
) -> Float[Array, "*#batch point 2"]:
    """Map normalised image coordinates (x/z, y/z) to pixels."""
    return matmul(points_norm, transpose(K[..., :2, :2])) + K[..., None, :2, 2]


def normalised_from_pixels(
    K: Float[Array, "*#batch 3 3"], uv_px: Float[Array, "*#batch point 2"]
) -> Float[Array, "*#batch point 2"]:
    """Map pixels to normalised image coordinates (x/z, y/z)."""
    inverse = invert_intrinsics(K)
    # Subtract the principal point first: it cancels digits that K^-1 [u, v, 1] would keep only in float64.
    return matmul(uv_px - K[..., None, :2, 2], transpose(inverse[..., :2, :2]))


def invert_intrinsics(K: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Return K^-1 in closed form; the last row of K must be (0, 0, 1)."""
    xp = array_namespace(K)
    a, b, c, d = K[..., 0, 0], K[..., 0, 1], K[..., 1, 0], K[..., 1, 1]
    det = a * d - b * c
    upper = xp.stack([xp.stack([d, -b], axis=-1), xp.stack([-c, a], axis=-1)], axis=-2) / det[..., None, None]
    offset = -matmul(upper, K[..., :2, 2:])
    return xp.concatenate([xp.concatenate([upper, offset], axis=-1), K[..., 2:, :]], axis=-2)


def transform_pixels(
    H_b_from_a: Float[Array, "*#batch 3 3"], uv_a: Float[Array, "*#batch point 2"]
) -> Float[Array, "*#batch point 2"]:
    """Map pixels of image a to pixels of image b by a homography."""
    xp = array_namespace(H_b_from_a, uv_a)
    homogeneous = xp.concatenate([uv_a, xp.ones_like(uv_a[..., :1])], axis=-1)
    mapped = matmul(homogeneous, transpose(H_b_from_a))
    return mapped[..., :2] / _safe_depth(mapped[..., 2:])


def index_homography(H_b_from_a: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Rewrite a homography for libraries (OpenCV) whose pixel (0, 0) is a pixel's centre, for warping
    images."""
    xp = array_namespace(H_b_from_a)
    to_span = xp.asarray([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], dtype=H_b_from_a.dtype)
    to_index = xp.asarray([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]], dtype=H_b_from_a.dtype)
    return matmul(matmul(to_index, H_b_from_a), to_span)


def pixel_centres(hw: tuple[int, int], dtype: type = np.float32) -> Float[Array, "h w 2"]:
    """Return the (u, v) of every pixel centre of an image, as NumPy."""
    v, u = np.meshgrid(np.arange(hw[0]) + 0.5, np.arange(hw[1]) + 0.5, indexing="ij")
    return np.stack([u, v], axis=-1).astype(dtype)


def crop_homography(box_px: Float[Array, "*batch 4"], out_hw: tuple[int, int]) -> Float[Array, "*batch 3 3"]:
    """Return `H_crop_from_image` for the box x0 y0 x1 y1 (image pixels) resized to `out_hw`.

    A box without extent, as padded views have, is given the extent of one pixel.
    """
    xp = array_namespace(box_px)
    start, extent = box_px[..., :2], box_px[..., 2:] - box_px[..., :2]
    extent = xp.where(extent > 0, extent, xp.ones_like(extent))
    scale = xp.asarray([out_hw[1], out_hw[0]], dtype=box_px.dtype) / extent
    diagonal = xp.concatenate([scale, xp.ones_like(scale[..., :1])], axis=-1)
    offset = xp.concatenate([-scale * start, xp.zeros_like(scale[..., :1])], axis=-1)
    eye = xp.eye(3, dtype=box_px.dtype)
    return diagonal[..., :, None] * eye + offset[..., :, None] * eye[2]


def crop_intrinsics(
    K: Float[Array, "*#batch 3 3"], box_px: Float[Array, "*#batch 4"], out_hw: tuple[int, int]
) -> Float[Array, "*#batch 3 3"]:
    """Return the intrinsics of the crop of `box_px` (x0 y0 x1 y1) resized to `out_hw`."""
    return matmul(crop_homography(box_px, out_hw), K)


def resize_intrinsics(
    K: Float[Array, "*batch 3 3"], from_hw: tuple[int, int], to_hw: tuple[int, int]
) -> Float[Array, "*batch 3 3"]:
    """Return the intrinsics of the whole image resized from `from_hw` to `to_hw`."""
    xp = array_namespace(K)
    return crop_intrinsics(K, xp.asarray([0, 0, from_hw[1], from_hw[0]], dtype=K.dtype), to_hw)


def roll(
    K: Float[Array, "*#batch 3 3"],
    T_cam_from_world: Float[Array, "*#batch 4 4"],
    angle: Float[Array, "*#batch"] | float,
) -> tuple[Float[Array, "*#batch 4 4"], Float[Array, "*#batch 3 3"]]:
    """Turn cameras about their optical axes while the hand stays (paper, section "Data Augmentation").

    The extrinsic becomes Rot(a) T; the image is to be warped by K Rot(a) K^-1, exact also where fx differs
    from fy and with skew; K stays.

    Returns: `T_rolled_from_world`, and `H_rolled_from_image` in pixels.
    """
    xp = array_namespace(K, T_cam_from_world, angle)
    R_rolled_from_cam = rotation_about_z(xp.asarray(angle, dtype=T_cam_from_world.dtype))
    T_rolled_from_cam = rigid(R_rolled_from_cam, xp.zeros_like(R_rolled_from_cam[..., 0]))
    homography = matmul(matmul(K, R_rolled_from_cam), invert_intrinsics(K))
    return matmul(T_rolled_from_cam, T_cam_from_world), homography


def primary_view(view_mask: Bool[Array, "*batch view"]) -> Int[Array, "*batch"]:
    """Return the index of the first valid view; 0 where there is none."""
    return array_namespace(view_mask).argmax(view_mask, axis=-1)


def fill_masked_views(cams: Cameras) -> Cameras:
    """Replace whatever masked views hold (zeros, NaN) by identity matrices, so that nothing leaks from
    them."""
    xp = array_namespace(*cams)
    mask = cams.view_mask[..., None, None]
    K = xp.where(mask, cams.K, xp.eye(3, dtype=cams.K.dtype))
    T_cam_from_world = xp.where(mask, cams.T_cam_from_world, xp.eye(4, dtype=cams.T_cam_from_world.dtype))
    return Cameras(K, T_cam_from_world, cams.view_mask)


def anchor_to_primary(
    T_cam_from_world: Float[Array, "*batch view 4 4"], view_mask: Bool[Array, "*batch view"]
) -> tuple[Float[Array, "*batch view 4 4"], Float[Array, "*batch 4 4"]]:
    """Make the primary camera (the first valid view) the world.

    Returns: `T_cam_from_primary`, exactly the identity for the primary view and for masked views, and
    `T_primary_from_world`, the identity where no view is valid.
    """
    xp = array_namespace(T_cam_from_world, view_mask)
    eye = xp.eye(4, dtype=T_cam_from_world.dtype)
    filled = xp.where(view_mask[..., None, None], T_cam_from_world, eye)
    index = primary_view(view_mask)
    T_primary_from_world = xp.take_along_axis(filled, index[..., None, None, None], axis=-3)[..., 0, :, :]
    relative = matmul(filled, invert_rigid(T_primary_from_world)[..., None, :, :])
    others = view_mask & (xp.arange(view_mask.shape[-1]) != index[..., None])
    return xp.where(others[..., None, None], relative, eye), T_primary_from_world


def mirror_world(T_cam_from_primary: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """Return D T D with D = diag(-1, 1, 1, 1): the extrinsics of the world mirrored in the primary's Y-Z
    plane.

    With flipped images, `mirror_intrinsics` and `mirror_points` the mirrored capture is a real one, of the
    other
    hand: projecting mirrored points gives `mirror_pixels` of the originals.
    """
    xp = array_namespace(T_cam_from_primary)
    d = xp.asarray([-1, 1, 1, 1], dtype=T_cam_from_primary.dtype)
    return T_cam_from_primary * d[:, None] * d


def mirror_intrinsics(K: Float[Array, "*batch 3 3"], width: int) -> Float[Array, "*batch 3 3"]:
    """Return the intrinsics of the image flipped left to right: cx' = W - cx, skew negated."""
    xp = array_namespace(K)
    sign = xp.asarray([[1, -1, -1], [-1, 1, 1], [1, 1, 1]], dtype=K.dtype)
    return K * sign + xp.asarray([[0, 0, width], [0, 0, 0], [0, 0, 0]], dtype=K.dtype)


def mirror_points(points_primary: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Mirror points of the primary camera's frame in its Y-Z plane; its own inverse."""
    xp = array_namespace(points_primary)
    return points_primary * xp.asarray([-1, 1, 1], dtype=points_primary.dtype)


def mirror_pixels(uv_px: Float[Array, "*batch 2"], width: int) -> Float[Array, "*batch 2"]:
    """Flip pixels left to right, u' = W - u."""
    xp = array_namespace(uv_px)
    return uv_px * xp.asarray([-1, 1], dtype=uv_px.dtype) + xp.asarray([width, 0], dtype=uv_px.dtype)


def _safe_depth(z: Array) -> Array:
    """Keep depths at least `MIN_DEPTH` away from zero, with their sign (+ for zero)."""
    xp = array_namespace(z)
    nearest = xp.where(z < 0, -MIN_DEPTH, MIN_DEPTH).astype(z.dtype)
    return xp.where(xp.abs(z) < MIN_DEPTH, nearest, z)
