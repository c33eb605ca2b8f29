"""Whether a model's second stage uses the images: its errors with other image features than its own.

The first stage looks at every view alone (`Poem.look`), the second joins the views (`Poem.find_hands`).
Between the two the feature maps can be replaced, and nothing else: heat maps, cameras and root stay. A second
stage that reads the images does worse on the very same captures; one that is dead does not notice.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.data.batching import collate
from poem_jax.evaluation.benchmark import Captures
from poem_jax.evaluation.metrics import point_distances
from poem_jax.evaluation.protocols import MM_PER_METRE
from poem_jax.geometry.cameras import Cameras
from poem_jax.models.config import Config
from poem_jax.models.layers import NormMode
from poem_jax.models.network import ViewFeatures, assemble, number_type
from poem_jax.models.world_frame import enter_working_frame
from poem_jax.typing import Array, Float, Num, Params


class FeatureErrors(NamedTuple):
    """Mean vertex error of every capture in mm, by the feature maps that the second stage was given."""

    own: Float[np.ndarray, " sample"]
    zero: Float[np.ndarray, " sample"]
    """Maps of zeros."""
    another: Float[np.ndarray, " sample"]
    """Maps of another capture of the batch."""


class PairedDifference(NamedTuple):
    """How much worse one way is than another on the same captures."""

    mean_mm: float
    standard_error_mm: float
    """Of the mean: the spread of the differences over the captures, by the root of their number."""


def errors_by_features(
    params: Params,
    config: Config,
    captures: Captures,
    *,
    samples: int,
    num_views: int,
    batch_size: int = 8,
) -> FeatureErrors:
    """Reconstruct captures 0, 1, ... from their own features, from none, and from another capture's.

    Args:
        params: as `apply` takes them.
        config: as `apply` takes it.
        captures: where the samples come from; their first `num_views` views are used.
        samples: how many; a multiple of `batch_size`.
        num_views: at least 2, so that the first stage finds the root.
        batch_size: captures at a time, at least 2; one gets the feature maps of the one before it.

    Raises:
        ValueError: counts other than these.
    """
    if batch_size < 2 or samples < 1 or samples % batch_size:
        raise ValueError(
            "`samples` must be a multiple of `batch_size`, and that at least 2, for features are exchanged "
            f"within a batch; got {samples} and {batch_size}"
        )
    if num_views < 2:
        raise ValueError(f"`num_views` must be at least 2: one view does not fix the root; got {num_views}")
    errors: list[FeatureErrors] = []
    for start in range(0, samples, batch_size):
        chosen = [captures.sample(index, num_views=num_views) for index in range(start, start + batch_size)]
        batch = collate(chosen, num_views)
        seen = _look(params, batch.views, config=config)
        maps = seen.feature_maps
        found = [
            _find(params, seen._replace(feature_maps=given), batch.views, batch.cameras, config=config)
            for given in (maps, jnp.zeros_like(maps), jnp.roll(maps, 1, axis=0))
        ]
        errors.append(FeatureErrors(*(_errors_mm(vertices, batch.vertices_world) for vertices in found)))
    return FeatureErrors(*(np.concatenate(parts) for parts in zip(*errors, strict=True)))


def paired_difference(
    errors: Float[np.ndarray, " sample"], reference: Float[np.ndarray, " sample"]
) -> PairedDifference:
    """Return how much larger `errors` are than `reference`, which is of the same captures, at least two."""
    difference = errors - reference
    spread = np.std(difference, ddof=1)
    return PairedDifference(float(difference.mean()), float(spread / np.sqrt(len(difference))))


@functools.partial(jax.jit, static_argnames="config")
def _look(params: Params, views: Num[Array, "batch view h w 3"], *, config: Config) -> ViewFeatures:
    return assemble(config, params).look(views, NormMode())


@functools.partial(jax.jit, static_argnames="config")
def _find(
    params: Params, seen: ViewFeatures, views: Array, cams: Cameras, *, config: Config
) -> Float[Array, "batch vert 3"]:
    frame = enter_working_frame(views, cams, None, number_type(params))
    return assemble(config, params).find_hands(seen, frame, NormMode()).vertices_world


def _errors_mm(vertices: Array, truth: Array) -> Float[np.ndarray, " sample"]:
    return MM_PER_METRE * point_distances(np.asarray(vertices, float), np.asarray(truth, float)).mean(-1)
