"""The held-out frames of a run's mixture, as batches for its validation."""

import itertools
import logging
import re
from collections.abc import Container

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.batching import collate
from poem_jax.data.frames import CorruptSampleError
from poem_jax.mixture.samples import FrameSamples, Mixture
from poem_jax.training.config import TrainConfig
from poem_jax.training.hosts import check_same_everywhere
from poem_jax.training.source import open_training_data

_log = logging.getLogger(__name__)


def held_out_batches(
    config: TrainConfig, mixture: Mixture | None = None, *, multiple_of: int = 1
) -> dict[str, list[MultiViewBatch]]:
    """Read the held-out frames of every part of the mixture that has some, up to `train.validation_samples`
    evenly spread over them; the same ones every time, all views, nothing augmented.

    Args:
        config: the experiment.
        mixture: its data, where they are open already.
        multiple_of: what sizes of batches must be a multiple of: the number of devices.

    Returns:
        Batches by the part's name, blanks as underscores, and numbered where two are alike then; the last one
        is filled up with samples that its `sample_mask` leaves out. Nothing where no part holds frames out.

    Raises:
        ValueError: none of a part's held-out frames can be used: they have one view each, say, in which the
            model cannot place a hand; or one host can use others than another, whose batches would differ.
    """
    parts = () if config.data.mixture is None else config.data.mixture.parts
    if not any(part.held_out for part in parts):
        return {}
    mixture = open_training_data(config) if mixture is None else mixture
    assert mixture is not None
    largest = max(shape.batch_size for shape in config.data.batches)
    batches: dict[str, list[MultiViewBatch]] = {}
    for name, frames in mixture.held_out.items():
        usable = _read(config, name, frames)
        # Before one host alone says that it has none: the others would wait for it.
        check_same_everywhere(f"held-out frames of {name} that can be used", str(list(usable)))
        samples = list(usable.values())
        if not samples:
            raise ValueError(
                f"none of {_count(config, frames)} held-out frames of {name} can be used; a "
                f"{type(config.model).__name__} needs {_least_views(config)} views of a hand. Leave that "
                "part's `held_out` at 0"
            )
        size = min(largest, -(-len(samples) // multiple_of) * multiple_of)
        chunks = [samples[i : i + size] for i in range(0, len(samples), size)]
        batches[_free_name(re.sub(r"\W+", "_", name), batches)] = [
            _filled(config, chunk, size) for chunk in chunks
        ]
    return batches


def _free_name(name: str, taken: Container[str]) -> str:
    """Return the name, or where another part has it the first of `name_2`, `name_3` ... that is free."""
    names = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
    return next(free for free in names if free not in taken)


def _read(config: TrainConfig, name: str, frames: FrameSamples) -> dict[int, MultiViewBatch]:
    """Return samples by their place in the source; those that cannot be used are named and left out."""
    usable = {}
    for index in np.linspace(0, len(frames.source) - 1, _count(config, frames)).round().astype(int).tolist():
        try:
            # Nothing of the sample is left to chance; augmenting draws all the same.
            sample = frames.sample(index, _most_views(config), np.random.default_rng(0))
        except CorruptSampleError as error:
            _log.warning("held-out sample of %s passed over: %s", name, error)
            continue
        if len(sample.views) >= _least_views(config):
            usable[index] = sample
    return usable


def _count(config: TrainConfig, frames: FrameSamples) -> int:
    return min(len(frames.source), config.train.validation_samples)


def _least_views(config: TrainConfig) -> int:
    return 2 if config.model.triangulates else 1


def _filled(config: TrainConfig, samples: list[MultiViewBatch], size: int) -> MultiViewBatch:
    batch = collate([*samples, *samples[-1:] * (size - len(samples))], _most_views(config))
    return batch._replace(sample_mask=np.arange(size) < len(samples))


def _most_views(config: TrainConfig) -> int:
    return max(shape.num_views for shape in config.data.batches)
