"""The paper's experiment on its six data sets, which the files of POEM v2's sizes name a model for."""

from dataclasses import replace

from poem_jax.data.augmentation_recipes import PAPER
from poem_jax.experiments.parts.data_sets import six_sets
from poem_jax.experiments.v2_base_synthetic import config as synthetic
from poem_jax.models.presets import preset
from poem_jax.training.config import BatchShape, TrainConfig
from poem_jax.training.recipes import experiment


def on_six_sets(name: str, model: str, *, raw: bool = False) -> TrainConfig:
    """Return the paper's recipe for a model on the six sets.

    Args:
        name: of the experiment.
        model: a preset of 256 x 256 pixels.
        raw: read raw data sets instead of tars.
    """
    data = replace(
        synthetic.data, batches=(BatchShape(num_views=8, batch_size=32),), mixture=six_sets(PAPER, raw=raw)
    )
    train = replace(synthetic.train, out=f"runs/{name}")
    return experiment("paper", name=name, model=preset(model), data=data, train=train)
