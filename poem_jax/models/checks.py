"""What `apply` asks of its inputs. Static facts always; values only where they are concrete, not traced."""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from poem_jax.geometry.camera_checks import check_cameras
from poem_jax.geometry.cameras import Cameras
from poem_jax.models.config import Config
from poem_jax.typing import Array


def check_inputs(views: Any, cams: Any, root_world: Any, config: Config) -> None:
    """Raise `ValueError` that says what, expected, got and fix; the arguments are those of `apply`."""
    _check_types(views, cams, root_world)
    _check_views(views, config)
    if np.shape(cams.K) != (*views.shape[:2], 3, 3):
        raise ValueError(
            f"`cams.K` must have shape (batch, view, 3, 3) = {(*views.shape[:2], 3, 3)}, as `views` says; "
            f"got {np.shape(cams.K)}"
        )
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((views, cams, root_world)))
    if root_world is not None and not traced:
        _check_root(np.asarray(root_world))
    check_cameras(cams, config.image_hw, root_world)
    if not traced:
        mask = np.asarray(cams.view_mask)
        _check_view_counts(mask, root_world)
        _check_float_images(views, mask)


def _check_types(views: Any, cams: Any, root_world: Any) -> None:
    if not isinstance(cams, Cameras):
        raise ValueError(
            f"`cams` must be `Cameras(K, T_cam_from_world, view_mask)`; got {type(cams).__name__}. "
            "Build it with `poem_jax.Cameras`"
        )
    arrays = {"views": views, **{f"cams.{name}": leaf for name, leaf in cams._asdict().items()}}
    if root_world is not None:
        arrays["root_world"] = root_world
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray | jax.Array):
            raise ValueError(
                f"`{name}` must be a NumPy or JAX array; got {type(array).__name__}. "
                f"Convert it with `numpy.asarray` (images: `numpy.stack`)"
            )


def _check_views(views: Array, config: Config) -> None:
    shape = np.shape(views)
    if len(shape) != 5 or shape[2:] != (*config.image_hw, 3):
        raise ValueError(
            f"`views` must have shape (batch, view, *{config.image_hw}, 3); got {shape}. "
            "Crop and resize the images, and adapt K, with `crop_intrinsics`."
        )
    if 0 in shape:
        raise ValueError(f"`views` must hold at least one sample of one view; got shape {shape}")
    if views.dtype != np.uint8 and "float" not in str(views.dtype):
        raise ValueError(f"`views` must be uint8, or float in [0, 1]; got {views.dtype}")


def _check_view_counts(mask: np.ndarray, root_world: Array | None) -> None:
    counts = mask.sum(-1)
    if (counts == 0).any():
        raise ValueError(
            f"every sample needs at least one valid view; `cams.view_mask` of samples {_where(counts == 0)} "
            "is all False. Drop these samples."
        )
    unknown = np.isnan(np.full((len(mask), 3), np.nan) if root_world is None else root_world).any(-1)
    lost = (counts == 1) & unknown
    if lost.any():
        raise ValueError(
            f"a sample with one valid view needs `root_world`, since one view does not fix the root; samples "
            f"{_where(lost)} have one, and no root. Give `root_world` of shape (batch, 3), or another view."
        )


def _check_root(root_world: np.ndarray) -> None:
    """NaN stands for an unknown root, which two views can triangulate."""
    unknown = np.isnan(root_world).all(-1)
    broken = np.asarray(~unknown & ~np.isfinite(root_world).all(-1))
    if broken.any():
        raise ValueError(
            "`root_world` must be finite, or NaN in all three coordinates where the root is unknown; samples "
            f"{_where(broken)} hold NaN or infinity"
        )


def _check_float_images(views: Array, mask: np.ndarray) -> None:
    if views.dtype == np.uint8:
        return
    low, high = (np.asarray(extreme(views, axis=(2, 3, 4)), np.float32) for extreme in (np.min, np.max))
    broken = mask & ~np.isfinite(low + high)
    if broken.any():
        raise ValueError(f"`views` must be finite; views {_where(broken)} hold NaN or infinity")
    low, high = low[mask].min(), high[mask].max()
    if low < 0 or high > 1:
        raise ValueError(
            f"float `views` must be in [0, 1]; got values from {low:g} to {high:g}. "
            "Divide by 255, or pass uint8."
        )


def _where(condition: np.ndarray) -> list:
    return (
        np.argwhere(condition).squeeze(-1).tolist()
        if condition.ndim == 1
        else np.argwhere(condition).tolist()
    )
