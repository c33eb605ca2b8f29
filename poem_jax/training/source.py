"""Training batches: a pure function of the step."""

from collections.abc import Callable

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.batching import collate
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.training.config import BatchShape, DataConfig, TrainConfig

BatchAt = Callable[[int], MultiViewBatch]

_BATCH_STREAM = 1000
"""Third part of the seed of a batch's layout; the dataset's own streams of a sample are small numbers."""


def synthetic_batches(config: DataConfig) -> BatchAt:
    """Return the function from a step to its batch.

    Nothing but the step and the seed decides a batch, so that a resumed run sees exactly the samples that it
    would have seen. No sample index comes twice.
    """
    dataset = SyntheticDataset(config.synthetic, seed=config.seed)
    largest = max(shape.batch_size for shape in config.batches)

    def batch_at(step: int) -> MultiViewBatch:
        rng = np.random.default_rng((config.seed, step, _BATCH_STREAM))
        shape = choose_shape(config, rng)
        counts = rng.integers(
            shape.min_views or shape.num_views, shape.num_views, shape.batch_size, endpoint=True
        )
        samples = [
            dataset.sample(step * largest + row, num_views=int(count)) for row, count in enumerate(counts)
        ]
        return collate(samples, shape.num_views)

    return batch_at


def choose_shape(config: DataConfig, rng: np.random.Generator) -> BatchShape:
    """Draw a kind of batch by its weight."""
    weights = np.array([shape.weight for shape in config.batches], dtype=np.float64)
    return config.batches[rng.choice(len(weights), p=weights / weights.sum())]


def validation_batches(config: TrainConfig, num_views: int) -> list[MultiViewBatch]:
    """Draw the held-out samples of a validation, `num_views` of each, padded with masked views to what the
    model is made for; the same ones every time."""
    dataset = SyntheticDataset(config.data.synthetic, seed=config.train.validation_seed)
    size = max(shape.batch_size for shape in config.data.batches)
    count = -(-config.train.validation_samples // size)
    padded = max(num_views, config.model.view_range[0])
    return [
        collate([dataset.sample(size * i + j, num_views=num_views) for j in range(size)], padded)
        for i in range(count)
    ]
