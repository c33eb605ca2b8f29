"""Batches of synthetic captures drawn by processes beside a GPU, which the threads of one could not feed.

They are those of `training.source.synthetic_batches`, sample for sample; the processes are a mixture's.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.batching import collate
from poem_jax.data.view_sampling import AllViews
from poem_jax.mixture.config import MixtureConfig, Part, SyntheticSource
from poem_jax.mixture.samples import open_mixture
from poem_jax.mixture.workers import Workers
from poem_jax.training.config import DataConfig
from poem_jax.training.source import _BATCH_STREAM, BatchAt, choose_shape


@contextmanager
def drawn_by_processes(config: DataConfig, count: int) -> Iterator[BatchAt]:
    """Give the function from a step to its batch, drawn by `count` processes, which end here."""
    # A mixture of one part gives at position n its capture n, with as many views as are asked for.
    alone = MixtureConfig((Part(SyntheticSource(), views=AllViews()),), pose=True)
    mixture = open_mixture(
        alone, synthetic=config.synthetic, seed=config.seed, image_hw=config.synthetic.image_hw
    )
    largest = max(shape.batch_size for shape in config.batches)
    with Workers(mixture, count) as workers:

        def batch_at(step: int) -> MultiViewBatch:
            rng = np.random.default_rng((config.seed, step, _BATCH_STREAM))
            shape = choose_shape(config, rng)
            least = shape.min_views or shape.num_views
            counts = rng.integers(least, shape.num_views, shape.batch_size, endpoint=True)
            waiting = [workers.submit(step * largest + row, int(views)) for row, views in enumerate(counts)]
            return collate([future.result().sample for future in waiting], shape.num_views)

        yield batch_at
