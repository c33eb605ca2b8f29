"""What may happen to the cameras between training and use: another order, fewer, others, or badly calibrated.

Pure functions of a batch and a key; views go with their cameras and key points, and the hand in the world
stays where it is.
"""

import jax
import jax.numpy as jnp

from poem_jax.batch import MultiViewBatch
from poem_jax.geometry.cameras import Cameras
from poem_jax.geometry.transforms import matmul, rigid, rotation_from_axis_angle
from poem_jax.typing import Array, Bool, Int, PRNGKeyArray


def shuffle_cameras(batch: MultiViewBatch, *, key: PRNGKeyArray) -> MultiViewBatch:
    """Put the valid views of each sample into a random order, so that another one is the primary camera.

    The paper's "cam. shuffle", table of robustness.
    """
    return _take(batch, _random_order(batch.cameras.view_mask, key))


def drop_cameras(batch: MultiViewBatch, num_views: int, *, key: PRNGKeyArray) -> MultiViewBatch:
    """Keep `num_views` random valid views of each sample, in random order; the others are masked, and the
    padded number of views stays.

    A sample with fewer keeps all that it has.

    Raises:
        ValueError: `num_views` is not positive.
    """
    if num_views < 1:
        raise ValueError(f"`num_views` must be at least 1; got {num_views}")
    shuffled = shuffle_cameras(batch, key=key)
    return _masked(shuffled, jnp.arange(batch.views.shape[1]) < num_views)


def replace_cameras(
    batch: MultiViewBatch, num_views: int, num_replaced: int, *, key: PRNGKeyArray
) -> MultiViewBatch:
    """Give each sample its first `num_views` views, but `num_replaced` of them, at random, exchanged.

    What comes in their places are views that the sample has beyond the first `num_views`, at random; where it
    has too few, fewer are exchanged. The result has `num_views` views.

    Raises:
        ValueError: `num_views` leaves no view to exchange with, or `num_replaced` is more than `num_views`.
    """
    if not 1 <= num_views < batch.views.shape[1]:
        raise ValueError(
            f"`num_views` must be from 1 to {batch.views.shape[1] - 1}, so that some are left to exchange "
            f"with; got {num_views}"
        )
    if not 0 <= num_replaced <= num_views:
        raise ValueError(f"`num_replaced` must be 0 to `num_views` = {num_views}; got {num_replaced}")
    mask = jnp.asarray(batch.cameras.view_mask)
    place = jnp.arange(mask.shape[1])
    first, rest = jnp.split(_random_ranks(mask, key, num_views), [num_views], axis=1)
    # The n-th view to go, by its rank, makes way for the n-th of the rest.
    spare = jnp.argsort(rest, axis=1) + num_views
    spares = jnp.sum(mask[:, num_views:], axis=1, keepdims=True)
    goes = (first < jnp.minimum(num_replaced, spares)) & mask[:, :num_views]
    chosen = jnp.take_along_axis(spare, jnp.minimum(first, spare.shape[1] - 1), axis=1)
    order = jnp.where(goes, chosen, place[:num_views])
    return _take(batch, order)


def noisy_extrinsics(
    batch: MultiViewBatch, sigma_m: float, sigma_rad: float, *, key: PRNGKeyArray
) -> MultiViewBatch:
    """Move every camera by N(0, sigma_m) along each of its axes, and turn it by N(0, sigma_rad) about each.

    Images, key points and the hand stay; only what the model is told of the cameras changes.

    Raises:
        ValueError: a negative spread.
    """
    if sigma_m < 0 or sigma_rad < 0:
        raise ValueError(f"`sigma_m` and `sigma_rad` must not be negative; got {sigma_m} and {sigma_rad}")
    K, T_cam_from_world, view_mask = batch.cameras
    of_place, of_turn = jax.random.split(key)
    shape = (*T_cam_from_world.shape[:2], 3)
    moved = sigma_m * jax.random.normal(of_place, shape)
    turned = rotation_from_axis_angle(sigma_rad * jax.random.normal(of_turn, shape))
    T = matmul(rigid(turned, moved), jnp.asarray(T_cam_from_world))
    return batch._replace(cameras=Cameras(K, T, view_mask))


def _random_order(mask: Bool[Array, "batch view"], key: PRNGKeyArray) -> Int[Array, "batch view"]:
    """Return places of views: the valid ones at random, then the others."""
    drawn = jax.random.uniform(key, mask.shape)
    return jnp.argsort(jnp.where(mask, drawn, 2.0), axis=1)


def _random_ranks(
    mask: Bool[Array, "batch view"], key: PRNGKeyArray, num_first: int
) -> Int[Array, "batch view"]:
    """Return the place of each view in a random order of the first ones, and in one of the rest."""
    drawn = jnp.where(mask, jax.random.uniform(key, mask.shape), 2.0)
    parts = jnp.split(drawn, [num_first], axis=1)
    return jnp.concatenate([jnp.argsort(jnp.argsort(part, axis=1), axis=1) for part in parts], axis=1)


def _take(batch: MultiViewBatch, order: Int[Array, "batch chosen"]) -> MultiViewBatch:
    """Return the views at these places."""

    def taken(leaf: Array) -> Array:
        places = order.reshape(*order.shape, *(1,) * (leaf.ndim - 2))
        return jnp.take_along_axis(jnp.asarray(leaf), places, axis=1)

    return batch._replace(
        views=taken(batch.views),
        keypoints_px=taken(batch.keypoints_px),
        cameras=Cameras(*(taken(leaf) for leaf in batch.cameras)),
    )


def _masked(batch: MultiViewBatch, kept: Bool[Array, " view"]) -> MultiViewBatch:
    K, T_cam_from_world, view_mask = batch.cameras
    return batch._replace(cameras=Cameras(K, T_cam_from_world, view_mask & kept))
