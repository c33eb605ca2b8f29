"""MvP with the paper's recipe, on endless synthetic captures at 256 x 256.

What:      ResNet-34 trunk, 21 queries that read 8 views about their projections, pose and shape of the hand
           after each of six layers; joints, vertices and the projections of both; else as v1_synthetic.
Hardware:  accelerators; every device takes an equal part of the batch. Neither memory nor speed was measured.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   poem train mvp_synthetic
"""

from dataclasses import replace

from poem_jax.experiments.v1_synthetic import config as v1
from poem_jax.models.presets import preset
from poem_jax.training.recipes import experiment

config = experiment(
    "mvp",
    name="mvp_synthetic",
    model=preset("mvp"),
    data=v1.data,
    train=replace(v1.train, out="runs/mvp_synthetic"),
)
