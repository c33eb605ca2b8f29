"""Differentiable multi-view geometry: pure functions over any leading batch axes.

What maps points, pixels and cameras follows the type of its arrays, NumPy or JAX; triangulation, sampling and
neighbours are JAX. All work within `jit` and `vmap`, and have gradients, but for the choice of neighbours.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from poem_jax.geometry.alignment import procrustes
    from poem_jax.geometry.cameras import (
        Cameras,
        crop_homography,
        crop_intrinsics,
        index_homography,
        mirror_intrinsics,
        mirror_pixels,
        mirror_points,
        mirror_world,
        project,
        unproject,
    )
    from poem_jax.geometry.distortion import distort_pixels, undistort_pixels
    from poem_jax.geometry.neighbours import gather, nearest
    from poem_jax.geometry.sampling import sample_bilinear, soft_argmax
    from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle, transform_points
    from poem_jax.geometry.triangulation import triangulate

_HOME = {
    "Cameras": "cameras",
    "crop_homography": "cameras",
    "crop_intrinsics": "cameras",
    "distort_pixels": "distortion",
    "gather": "neighbours",
    "index_homography": "cameras",
    "invert_rigid": "transforms",
    "mirror_intrinsics": "cameras",
    "mirror_pixels": "cameras",
    "mirror_points": "cameras",
    "mirror_world": "cameras",
    "nearest": "neighbours",
    "procrustes": "alignment",
    "project": "cameras",
    "rigid": "transforms",
    "rotation_from_axis_angle": "transforms",
    "sample_bilinear": "sampling",
    "soft_argmax": "sampling",
    "transform_points": "transforms",
    "triangulate": "triangulation",
    "undistort_pixels": "distortion",
    "unproject": "cameras",
}

__all__ = [
    "Cameras",
    "crop_homography",
    "crop_intrinsics",
    "distort_pixels",
    "gather",
    "index_homography",
    "invert_rigid",
    "mirror_intrinsics",
    "mirror_pixels",
    "mirror_points",
    "mirror_world",
    "nearest",
    "procrustes",
    "project",
    "rigid",
    "rotation_from_axis_angle",
    "sample_bilinear",
    "soft_argmax",
    "transform_points",
    "triangulate",
    "undistort_pixels",
    "unproject",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"poem_jax.geometry.{_HOME[name]}"), name)
    raise AttributeError(f"module 'poem_jax.geometry' has no attribute '{name}'")
