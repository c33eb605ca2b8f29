"""The model behind a reconstruction: loaded once, compiled once for one batch shape."""

import os
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from poem_jax.batch import Prediction
from poem_jax.capture.samples import HandResult, HandSample, empty_sample, take_result
from poem_jax.geometry.cameras import Cameras
from poem_jax.models.config import Config
from poem_jax.models.inference import Prepared, prepare, run_packed
from poem_jax.typing import Params
from poem_jax.weights import store


class Engine(NamedTuple):
    """A model and the number of hands that it takes at a time."""

    config: Config
    model: Prepared
    batch_size: int
    run: Callable[[Prepared, np.ndarray, Cameras], Prediction]
    """The forward pass over a padded batch."""
    origin: str
    """Where the weights came from, for the report."""


def load_engine(checkpoint: str | os.PathLike | None, batch_size: int) -> Engine:
    """Load a checkpoint folder, or the shipped weights for None.

    Raises:
        FileNotFoundError, ValueError: As `poem_jax.load`.
    """
    config, params = store.shipped() if checkpoint is None else store.load(checkpoint)
    origin = "shipped weights" if checkpoint is None else str(checkpoint)
    return make_engine(config, params, batch_size, origin)


def make_engine(config: Config, params: Params, batch_size: int, origin: str = "given") -> Engine:
    """Build an engine from a model in memory."""
    return Engine(config, prepare(params, config), batch_size, run_packed, origin)


def reconstruct_samples(engine: Engine, samples: Sequence[HandSample]) -> list[HandResult]:
    """Run up to `batch_size` samples; the batch is padded with masked ones, so that one program serves all.

    Raises:
        ValueError: More samples than the batch holds.
    """
    if len(samples) > engine.batch_size:
        raise ValueError(f"the engine takes {engine.batch_size} samples at a time; got {len(samples)}")
    if not samples:
        return []
    padding = empty_sample(len(samples[0].view_mask), engine.config.image_hw)
    padded = [*samples, *[padding] * (engine.batch_size - len(samples))]
    views, K, T_cam_from_world, view_mask = (np.stack(part) for part in zip(*padded, strict=True))
    cams = Cameras(K, T_cam_from_world, view_mask)
    prediction = jax.device_get(engine.run(engine.model, views, cams))
    return [take_result(prediction, index) for index in range(len(samples))]
