"""A batch taken part by part: the gradients of its parts, added up, are the gradient of the whole.

Part i of n holds every n-th sample from i on, of whatever share of the batch a device has: so a part is the
same samples on any number of devices. Losses are shares of the whole batch's (`losses.Share`). Only batch
norms see one part at a time, and a part in which a sample could not be solved gives its others more weight.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from poem_jax.batch import MultiViewBatch
from poem_jax.losses import existing_masks
from poem_jax.typing import Array, Bool, Float, Params, PRNGKeyArray, PyTree


class Part(NamedTuple):
    """What one pass through the model sees."""

    batch: MultiViewBatch
    root_world: Float[Array, "batch 3"] | None
    """Known roots, as `forward` takes them."""
    key: PRNGKeyArray
    """For what is dropped."""
    views: Float[Array, ""] | None = None
    """As in `losses.Share`."""
    samples: Float[Array, ""] | None = None


def in_parts(whole: Part, count: int, axis_name: str | None = None) -> Part:
    """Return the parts, stacked along a new first axis.

    Args:
        whole: a device's share of the batch.
        count: how many parts.
        axis_name: mapped axis over which the batch is split.

    Raises:
        ValueError: the share is no multiple of `count`.
    """
    size = len(whole.batch.views)
    if size % count:
        raise ValueError(
            f"a device's share of a batch must be a multiple of `compute.accumulate` = {count}; got {size} "
            "samples. Change `data.batches`, or the number of parts"
        )
    batch, root_world = jax.tree.map(lambda leaf: _every_nth(leaf, count), whole[:2])
    view_mask, sample_mask = existing_masks(whole.batch)
    views, samples = (_shares(_every_nth(mask, count), axis_name) for mask in (view_mask, sample_mask))
    keys = jax.vmap(lambda i: jax.random.fold_in(whole.key, i))(jnp.arange(count))
    return Part(batch, root_world, keys, views, samples)


def add_up(
    gradient_of: Callable[[Part, Params], tuple[Params, tuple[dict[str, Array], Params]]],
    parts: Part,
    statistics: Params,
) -> tuple[Params, tuple[dict[str, Array], Params]]:
    """Take part after part; the statistics move with each.

    Args:
        gradient_of: from a part and the statistics to gradients, metrics and the next statistics.
        parts: from `in_parts`.
        statistics: before the first part.

    Returns: what `gradient_of` would return of the whole batch.
    """

    def add(carry: tuple[PyTree, Params], part: Part) -> tuple[tuple[PyTree, Params], None]:
        total, statistics = carry
        gradients, (metrics, statistics) = gradient_of(part, statistics)
        return (jax.tree.map(jnp.add, total, (gradients, metrics)), statistics), None

    first = jax.tree.map(lambda leaf: leaf[0], parts)
    gradients, (metrics, _) = jax.eval_shape(gradient_of, first, statistics)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), (gradients, metrics))
    # XLA:CPU runs the gradients of convolutions inside a loop a hundred times slower than outside.
    written_out = jax.default_backend() == "cpu"
    (total, statistics), _ = jax.lax.scan(add, (nothing, statistics), parts, unroll=written_out)
    return total[0], (total[1], statistics)


def _every_nth(leaf: Any, count: int) -> Array:
    """Lay out rows as (part, row of it)."""
    return jnp.moveaxis(jnp.reshape(leaf, (-1, count, *leaf.shape[1:])), 1, 0)


def _shares(mask: Bool[Array, "part batch *rest"], axis_name: str | None) -> Float[Array, " part"]:
    """Return how much of what exists is in each part, on all devices together."""
    counts = jnp.sum(mask, range(1, mask.ndim), jnp.float32)
    if axis_name is not None:
        counts = jax.lax.psum(counts, axis_name)
    return counts / jnp.maximum(jnp.sum(counts), 1.0)
