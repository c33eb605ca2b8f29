"""Training batches: a pure function of the step, from synthetic captures or a mixture of data sets.

A step's samples have numbers that no host and no device enters into. Of several hosts each draws one block of
them, so that all together have the batch of a single one, in its order.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.batching import collate
from poem_jax.mixture.files import check_files
from poem_jax.mixture.samples import Mixture, open_mixture
from poem_jax.mixture.stream import MixtureStream, host_rows
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.training.config import BatchShape, DataConfig, TrainConfig
from poem_jax.training.hosts import is_first_host, wait_for_all

BatchAt = Callable[[int], MultiViewBatch]
DrawSamples = Callable[[Sequence[tuple[int, int]]], Sequence[MultiViewBatch]]
"""From indices of samples, each with its number of views, to the samples."""

_BATCH_STREAM = 1000
"""Third part of the seed of a batch's layout; the dataset's own streams of a sample are small numbers."""


DATA_FILES = "data_files.json"
"""In a run's folder: what identifies the files that it was begun with."""


def open_training_data(config: TrainConfig) -> Mixture | None:
    """Open the sources of the config's mixture, if it has one; before anything is written or compiled.

    Raises:
        FileNotFoundError: a root, a split's file, or MANO is missing.
        ValueError: a source is empty, or its files are not what they should be.
    """
    if config.data.mixture is None:
        return None
    return open_mixture(
        config.data.mixture,
        synthetic=config.data.synthetic,
        seed=config.data.seed,
        image_hw=config.model.image_hw,
    )


@contextmanager
def training_batches(config: TrainConfig, mixture: Mixture | None, *, begun: bool) -> Iterator[BatchAt]:
    """Give the function from a step to this host's rows of its batch, for the run in `config.train.out`;
    workers end here.

    Args:
        config: the experiment.
        mixture: its data, opened by `open_training_data`; None = synthetic captures.
        begun: the run has a checkpoint already.

    Raises:
        ValueError: the run was begun with other files, or nobody knows with which; or this host's files are
            not those of the first one.
    """
    host, hosts = jax.process_index(), jax.process_count()
    if mixture is None or config.data.mixture is None:
        yield synthetic_batches(config.data, host=host, hosts=hosts)
        return
    run_dir, options = Path(config.train.out), config.data.mixture
    _check_files(config, mixture, begun=begun)
    with MixtureStream(
        mixture,
        processes=options.processes,
        # Of what the other hosts could not use, each has a report of its own.
        run_dir=run_dir if is_first_host() else run_dir / f"host_{host}",
        max_corrupt_share=options.max_corrupt_share,
    ) as stream:
        yield mixture_batches(config.data, stream, host=host, hosts=hosts)


def _check_files(config: TrainConfig, mixture: Mixture, *, begun: bool) -> None:
    """Compare the data with those that the run began with; the other hosts' with the first one's."""
    file, allow_change = Path(config.train.out) / DATA_FILES, config.train.allow_config_change
    if is_first_host():
        check_files(file, mixture.fingerprint(), allow_change=allow_change, begun=begun)
    wait_for_all("the first host's data are checked")
    if not is_first_host():
        check_files(file, mixture.fingerprint(), allow_change=False, begun=True)


def drawing_threads(config: DataConfig) -> int:
    """Return how many batches are drawn at a time.

    Two where processes draw the samples, even if one thread is asked for: the other's samples keep them busy
    while the last ones of a batch are waited for and stacked.
    """
    has_processes = config.mixture is not None and config.mixture.processes > 0
    return max(config.workers, 2) if has_processes else config.workers


def mixture_batches(config: DataConfig, stream: MixtureStream, *, host: int = 0, hosts: int = 1) -> BatchAt:
    """Return the function from a step to this host's part of its batch.

    A batch has as many views as its `BatchShape`; samples have as many as their part of the mixture draws, of
    at most that. Nothing but the step and the seed decides a batch.
    """
    largest = max(shape.batch_size for shape in config.batches)

    def batch_at(step: int) -> MultiViewBatch:
        shape = choose_shape(config, np.random.default_rng((config.seed, step, _BATCH_STREAM)))
        rows = host_rows(step, shape.batch_size, largest, host=host, hosts=hosts)
        return collate(stream.samples(rows, shape.num_views), shape.num_views)

    return batch_at


def synthetic_batches(
    config: DataConfig, *, draw: DrawSamples | None = None, host: int = 0, hosts: int = 1
) -> BatchAt:
    """Return the function from a step to this host's part of its batch.

    Nothing but the step and the seed decides a batch, so that a resumed run sees exactly the samples that it
    would have seen. No sample index comes twice.

    Args:
        config: the kinds of batches, and of which captures.
        draw: gives the samples of a batch, each asked for by its index and its number of views; None = one
            after the other, here.
        host, hosts: this one, of how many.
    """
    largest = max(shape.batch_size for shape in config.batches)
    draw = draw or _drawn_here(config)

    def batch_at(step: int) -> MultiViewBatch:
        rng = np.random.default_rng((config.seed, step, _BATCH_STREAM))
        shape = choose_shape(config, rng)
        counts = rng.integers(
            shape.min_views or shape.num_views, shape.num_views, shape.batch_size, endpoint=True
        )
        rows = host_rows(step, shape.batch_size, largest, host=host, hosts=hosts)
        return collate(draw([(row, int(counts[row - step * largest])) for row in rows]), shape.num_views)

    return batch_at


def _drawn_here(config: DataConfig) -> DrawSamples:
    dataset = SyntheticDataset(config.synthetic, seed=config.seed)
    return lambda asked: [dataset.sample(index, num_views=views) for index, views in asked]


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
