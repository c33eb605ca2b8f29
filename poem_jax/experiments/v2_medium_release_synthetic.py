"""The released medium model with the release's own recipe, on endless synthetic captures at 256 x 256.

What:      the authors' architecture, losses on the last layer, every gradient tensor clipped to norm 1, root
           noise shared by the batch, dropout 0.1, Adam 1e-4 divided by ten at 70 %; batch 32. Start from
           imported weights with `--train.init-from DIR` (poem import-torch) to fine-tune them.
Hardware:  accelerators; every device takes an equal part of the batch. Neither memory nor speed was measured.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   poem train v2_medium_release_synthetic
"""

from dataclasses import replace

from poem_jax.experiments.v2_base_synthetic import config as base
from poem_jax.models.presets import preset
from poem_jax.training.recipes import experiment

config = experiment(
    "release",
    name="v2_medium_release_synthetic",
    model=preset("v2-medium-release"),
    data=base.data,
    train=replace(base.train, out="runs/v2_medium_release_synthetic"),
)
