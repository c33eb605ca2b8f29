"""From single samples to padded batches: stacking, padding of views and of the last batch.

A sample is a `MultiViewBatch` without the batch axis; everything stays NumPy. Padded views hold zeros in the
images and key points, and a camera that is harmless to compute with: the sample's own first camera.
"""

from collections.abc import Sequence

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.geometry.cameras import Cameras
from poem_jax.typing import Array


def collate(samples: Sequence[MultiViewBatch], num_views: int) -> MultiViewBatch:
    """Stack samples of up to `num_views` views into one batch of exactly `num_views` views.

    Args:
        samples: at least one, all of one image size and with the same optional fields present.
        num_views: the batch's V; views beyond a sample's own are padding (`view_mask` False).

    Returns:
        The batch; `sample_mask` is all True.

    Raises:
        ValueError: no sample, a sample with more views than `num_views`, or fields that do not stack.
    """
    if not samples:
        raise ValueError("`samples` must hold at least one sample; got none")
    padded = [pad_views(sample, num_views) for sample in samples]
    fields = {name: _stack(name, [getattr(s, name) for s in padded]) for name in _STACKED}
    cameras = Cameras(*(np.stack(leaves) for leaves in zip(*(s.cameras for s in padded), strict=True)))
    return MultiViewBatch(cameras=cameras, sample_mask=np.ones(len(samples), dtype=bool), **fields)


_STACKED = [name for name in MultiViewBatch._fields if name not in ("cameras", "sample_mask")]


def _stack(name: str, values: list[Array | None]) -> Array | None:
    present = [v for v in values if v is not None]
    if not present:
        return None
    shapes = {np.shape(v) for v in present}
    if len(present) < len(values) or len(shapes) > 1:
        missing = len(values) - len(present)
        raise ValueError(
            f"`{name}` must be present with one shape in every sample of a batch; "
            f"got shapes {sorted(shapes)}, missing in {missing} of {len(values)}"
        )
    return np.stack(present)


def pad_views(sample: MultiViewBatch, num_views: int) -> MultiViewBatch:
    """Pad one sample, or a batch of samples, with masked views, up to `num_views`.

    Raises:
        ValueError: the sample has no view, or more than `num_views`.
    """
    views = sample.views.shape[-4]
    if not 1 <= views <= num_views:
        raise ValueError(f"a sample must have 1 to {num_views} views; got {views}")
    padding = num_views - views
    K, T_cam_from_world, view_mask = sample.cameras
    return sample._replace(
        views=_pad_with_zeros(sample.views, padding, -4),
        keypoints_px=_pad_with_zeros(sample.keypoints_px, padding, -3),
        cameras=Cameras(
            _pad_with_first(K, padding, -3),
            _pad_with_first(T_cam_from_world, padding, -3),
            _pad_with_zeros(view_mask, padding, -1),
        ),
    )


def pad_batch(batch: MultiViewBatch, size: int) -> MultiViewBatch:
    """Pad a batch to `size` samples by repeating its first; `sample_mask` is False for the repeats.

    Raises:
        ValueError: the batch is larger than `size`.
    """
    batch_size = batch.views.shape[0]
    if batch_size > size:
        raise ValueError(f"a batch of {batch_size} samples does not fit into a padded size of {size}")
    mask = np.ones(batch_size, dtype=bool) if batch.sample_mask is None else np.asarray(batch.sample_mask)
    padding = size - batch_size
    fields = {name: _pad_with_first(getattr(batch, name), padding) for name in _STACKED}
    cameras = Cameras(*(_pad_with_first(leaf, padding) for leaf in batch.cameras))
    return MultiViewBatch(cameras=cameras, sample_mask=_pad_with_zeros(mask, padding), **fields)


def _pad_with_zeros(array: Array, padding: int, axis: int = 0) -> Array:
    shape = list(array.shape)
    shape[axis] = padding
    return np.concatenate([array, np.zeros(shape, array.dtype)], axis)


def _pad_with_first(array: Array | None, padding: int, axis: int = 0) -> Array | None:
    if array is None:
        return None
    return np.concatenate([array, np.repeat(np.take(array, [0], axis), padding, axis)], axis)
