"""What can be wrong with cameras that a user hands in, said before anything is computed.

Only valid views are looked at: masked ones may hold anything. A crop far from the optical axis has its
principal point far outside the image and is right, so the values of K cannot be judged alone. What tells is
whether some point within reach projects near every image at once: `views_meet`.
"""

import sys
from typing import Any

import numpy as np

from poem_jax.geometry.cameras import Cameras, fill_masked_views, invert_intrinsics, primary_view, project
from poem_jax.geometry.transforms import invert_rigid, matmul, rotate_points, transform_points, transpose
from poem_jax.typing import Array

MAX_CAMERA_DISTANCE = 20.0
"""Metres between two cameras that see one hand; the same rig in millimetres exceeds it by far."""

MAX_TANGENT = 6.0
"""Tangent of the widest angle to the optical axis (80 degrees) that a pinhole image is believed to hold."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of |R R^T - I| that counts as rounding of a rotation."""

INVERTED = (
    "`T_cam_from_world` must map world points to camera points; got matrices under which no point is in all "
    "views, while under their inverses there is one; pass the inverses (`invert_rigid`)"
)
"""What to say of extrinsics that map camera to world."""

_REACH = (0.02, MAX_CAMERA_DISTANCE)
_RAYS_PER_SIDE = 9


def check_cameras(cams: Cameras, image_hw: tuple[int, int], root_world: Array | None = None) -> None:
    """Check cameras against the images they belong to; arrays under a JAX trace are checked for shape only.

    Args:
        cams: cameras with any leading axes before `view`.
        image_hw: height and width in pixels of the images as fed.
        root_world: a point of the hand (*batch, 3), metres, if known; it makes the test of K sharper. Rows
            that are not finite are unknown.

    Raises: ValueError: wrong shapes or dtypes; in a valid view NaN, an R that is no rotation, a last row
    other than
        0 0 0 1, a K that is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths or that
        belongs to another resolution; extrinsics in millimetres; extrinsics that map camera to world.
    """
    _check_arrays(cams, root_world)
    _check_shapes(cams, root_world)
    _check_dtypes(cams)
    arrays = [*cams] if root_world is None else [*cams, root_world]
    if any(_is_traced(a) for a in arrays):
        return
    mask = np.asarray(cams.view_mask)
    cams = Cameras(np.asarray(cams.K, np.float64), np.asarray(cams.T_cam_from_world, np.float64), mask)
    K, T, _ = fill_masked_views(cams)
    _check_intrinsics(K, mask, image_hw)
    _check_extrinsics(T, mask)
    flat = Cameras(*(a.reshape(-1, *a.shape[mask.ndim - 1 :]) for a in (K, T, mask)))
    root = None if root_world is None else np.asarray(root_world, np.float64).reshape(-1, 3)
    check_distances(flat)
    _check_direction(flat, image_hw)
    _check_resolution(flat, image_hw, root)


def rotation_error(R: Array) -> Array:
    """Return the largest entry of |R R^T - I| (*batch); above `ROTATION_TOLERANCE` it is no rotation."""
    return np.abs(matmul(R, transpose(R)) - np.eye(3)).max((-1, -2))


def has_form_of_intrinsics(K: Array) -> Array:
    """Tell (*batch) whether K is [[fx, s, cx], [0, fy, cy], [0, 0, 1]], whatever the signs of fx and fy."""
    return (np.abs(K[..., 2, :] - [0, 0, 1]) <= 1e-6).all(-1) & (K[..., 1, 0] == 0)


def _check_arrays(cams: Cameras, root_world: Array | None) -> None:
    named = {**cams._asdict(), "root_world": np.zeros(3) if root_world is None else root_world}
    for name, value in named.items():
        if not hasattr(value, "shape"):
            raise ValueError(f"`{name}` must be an array; got {type(value).__name__}: pass np.asarray(...)")


def _check_shapes(cams: Cameras, root_world: Array | None) -> None:
    K, T, mask = cams
    if K.ndim < 3 or K.shape[-2:] != (3, 3):
        raise ValueError(f"`K` must have shape (*batch, view, 3, 3); got {K.shape}")
    if K.shape[-3] == 0:
        raise ValueError(f"cameras must have at least one view; got `K` of shape {K.shape}")
    lead = K.shape[:-2]
    wanted = [("T_cam_from_world", T, "(*batch, view, 4, 4)", (*lead, 4, 4))]
    wanted += [("view_mask", mask, "(*batch, view)", lead)]
    if root_world is not None:
        wanted.append(("root_world", root_world, "(*batch, 3)", (*lead[:-1], 3)))
    for name, array, meaning, shape in wanted:
        if array.shape != shape:
            raise ValueError(f"`{name}` must have shape {meaning} = {shape}, as `K` has; got {array.shape}")


def _check_dtypes(cams: Cameras) -> None:
    for name, array in (("K", cams.K), ("T_cam_from_world", cams.T_cam_from_world)):
        # By name, since NumPy does not count bfloat16 among its floating types.
        if "float" not in str(array.dtype):
            raise ValueError(f"`{name}` must be floating point; got {array.dtype}: use .astype(float32)")
    if cams.view_mask.dtype != bool:
        raise ValueError(f"`view_mask` must be bool, True = valid; got {cams.view_mask.dtype}")


def _is_traced(array: Array) -> bool:
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(array, jax.core.Tracer)


def _check_intrinsics(K: Array, mask: Array, image_hw: tuple[int, int]) -> None:
    _refuse(mask & ~np.isfinite(K).all((-1, -2)), "`K` must be finite", K, "mask views without one")
    _refuse(
        mask & ~has_form_of_intrinsics(K),
        "`K` must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]]",
        K,
        "is it transposed, or scaled as a whole? only the first two rows are in pixels",
    )
    focal = np.stack([K[..., 0, 0], K[..., 1, 1]], -1)
    _refuse(
        mask & (focal <= 0).any(-1),
        "the focal lengths of `K` must be positive",
        focal,
        "flip the image, not K",
    )
    size = np.asarray([image_hw[1], image_hw[0]], np.float64)
    wide = np.where(focal > 0, size / np.where(focal > 0, 2 * focal, 1), 0) > MAX_TANGENT
    _refuse(
        mask & wide.any(-1),
        f"the focal lengths of `K` must be in pixels of the image as fed (h, w) = {image_hw}",
        focal,
        "they look normalised: multiply the first two rows of K by the image's width and height",
    )


def _check_extrinsics(T: Array, mask: Array) -> None:
    _refuse(
        mask & ~np.isfinite(T).all((-1, -2)), "`T_cam_from_world` must be finite", T, "mask views without one"
    )
    _refuse(
        mask & (np.abs(T[..., 3, :] - [0, 0, 0, 1]) > 1e-6).any(-1),
        "the last row of `T_cam_from_world` must be (0, 0, 0, 1)",
        T[..., 3, :],
        "is it transposed? it multiplies column vectors",
    )
    R = T[..., :3, :3]
    error = rotation_error(R)
    _refuse(
        error > ROTATION_TOLERANCE,
        f"R of `T_cam_from_world` must be orthonormal, |R R^T - I| <= {ROTATION_TOLERANCE}",
        error,
        "remove scale and shear, for example by projecting R on the nearest rotation",
    )
    det = np.linalg.det(R)
    _refuse(
        det < 0,
        "R of `T_cam_from_world` must be a rotation, det R = 1",
        det,
        "it is a reflection: axes must be right-handed, x right, y down, z forward",
    )


def check_distances(cams: Cameras) -> None:
    """Refuse valid views of one sample that are too far apart; K and T are (batch, view, ...).

    Raises: ValueError: farther than `MAX_CAMERA_DISTANCE`.
    """
    centres = invert_rigid(cams.T_cam_from_world)[..., :3, 3]
    pairs = cams.view_mask[:, :, None] & cams.view_mask[:, None, :]
    distance = np.where(pairs, np.linalg.norm(centres[:, :, None] - centres[:, None], axis=-1), 0).max(-1)
    _refuse(
        distance > MAX_CAMERA_DISTANCE,
        f"cameras must be within {MAX_CAMERA_DISTANCE:g} m of each other",
        distance,
        "`T_cam_from_world` must be in metres; divide its last column by 1000 if it is in millimetres",
    )


def _check_direction(cams: Cameras, image_hw: tuple[int, int]) -> None:
    several = cams.view_mask.sum(-1) > 1
    inverse = cams._replace(T_cam_from_world=invert_rigid(cams.T_cam_from_world))
    inverted = ~views_meet(cams, image_hw, margin=0.5) & views_meet(inverse, image_hw, margin=0.0)
    # Most samples must say so: a single one may be odd, and two views often meet either way.
    if 2 * np.sum(inverted & several) > np.sum(several):
        raise ValueError(INVERTED)


def _check_resolution(cams: Cameras, image_hw: tuple[int, int], root_world: Array | None) -> None:
    size = np.asarray([image_hw[1], image_hw[0]], np.float64)
    centre, focal = cams.K[..., :2, 2], np.stack([cams.K[..., 0, 0], cams.K[..., 1, 1]], -1)
    mask = cams.view_mask
    outside = (np.maximum(-centre, centre - size) / size).max(-1)
    tangent = np.abs((size / 2 - centre) / focal).max(-1)
    far = mask & (outside > 1)
    lost = ~views_meet(cams, image_hw, margin=0.5)[:, None]
    if root_world is not None:
        known = np.isfinite(root_world).all(-1, keepdims=True)
        lost = np.where(known, _misses(cams, image_hw, np.where(known, root_world, 0)), lost)
    _refuse(
        mask & ((tangent > MAX_TANGENT) | (far & lost)),
        f"`K` must belong to the image as fed, (h, w) = {image_hw}; its principal point is far outside",
        centre,
        "scale K with `resize_intrinsics` or move it with `crop_intrinsics`, as the image was",
    )


def _misses(cams: Cameras, image_hw: tuple[int, int], root_world: Array) -> Array:
    """Tell, (batch, view), where the root lies behind the camera or half an image beside the image."""
    uv, depth = project(cams.K, cams.T_cam_from_world, root_world[:, None, None, :])
    size = np.asarray([image_hw[1], image_hw[0]])
    return (depth[..., 0] <= 0) | (np.abs(uv[..., 0, :] / size - 0.5) > 1).any(-1)


def views_meet(cams: Cameras, image_hw: tuple[int, int], margin: float) -> Array:
    """Tell, per sample (batch,), whether one point within reach projects into every valid image.

    Images are widened by `margin` of their size on each side. Along a ray of the primary camera "inside image
    j" is five linear inequalities a + b * depth >= 0, so the depths that all views see are an interval, found
    exactly; only the rays are sampled. Samples with fewer than two valid views meet.
    """
    origin, direction = _rays(cams, image_hw, margin)
    start = transform_points(cams.T_cam_from_world, origin[:, None, None, :])
    step = rotate_points(cams.T_cam_from_world[..., :3, :3], direction[:, None])
    normals = transpose(_inside_planes(cams.K, image_hw, margin))
    b = matmul(step, normals)
    a = np.broadcast_to(matmul(start, normals), b.shape)
    bound = -a / np.where(b == 0, 1, b)
    low = np.where(b > 0, bound, np.where((b == 0) & (a < 0), np.inf, _REACH[0]))
    high = np.where(b < 0, bound, _REACH[1])
    # The primary camera sees its own rays.
    index = np.arange(cams.view_mask.shape[-1])
    others = (cams.view_mask & (index != primary_view(cams.view_mask)[:, None]))[..., None, None]
    low = np.max(low, axis=(1, 3), where=others, initial=_REACH[0])
    high = np.min(high, axis=(1, 3), where=others, initial=_REACH[1])
    return (low <= high).any(-1)


def _rays(cams: Cameras, image_hw: tuple[int, int], margin: float) -> tuple[Array, Array]:
    """Return the primary camera's centre (batch, 3) and rays (batch, ray, 3), one metre deep, in the
    world."""
    index = (np.arange(len(cams.K)), primary_view(cams.view_mask))
    K, T = cams.K[index], cams.T_cam_from_world[index]
    side = np.linspace(-margin, 1 + margin, _RAYS_PER_SIDE)
    v, u = np.meshgrid(side * image_hw[0], side * image_hw[1], indexing="ij")
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=-1)
    T_world_from_cam = invert_rigid(T)
    rays_cam = rotate_points(invert_intrinsics(K), pixels)
    return T_world_from_cam[:, :3, 3], rotate_points(T_world_from_cam[:, :3, :3], rays_cam)


def _inside_planes(K: Array, image_hw: tuple[int, int], margin: float) -> Array:
    """Return normals (batch, view, 5, 3): camera points with n . x >= 0 for all five are inside the image."""
    low = [-margin * image_hw[1], -margin * image_hw[0]]
    high = [(1 + margin) * image_hw[1], (1 + margin) * image_hw[0]]
    rows = [K[..., i, :] - low[i] * K[..., 2, :] for i in range(2)]
    rows += [high[i] * K[..., 2, :] - K[..., i, :] for i in range(2)]
    return np.stack([*rows, K[..., 2, :]], axis=-2)


def _refuse(bad: Array, expected: str, got: Any, fix: str) -> None:
    """Raise for the first True of `bad`, whose axes are leading axes of `got`."""
    if not np.any(bad):
        return
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    value = np.array2string(np.asarray(got)[index], precision=6, separator=", ").replace("\n", "")
    raise ValueError(f"{expected}; got {value} at index {index}; {fix}")
