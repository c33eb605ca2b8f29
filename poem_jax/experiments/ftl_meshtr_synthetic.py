"""FTL-MeshTR with the paper's recipe, on endless synthetic captures at 256 x 256.

What:      ResNet-34 trunk, features moved as points and convolved over 8 views, a decoder of six layers;
           joints, vertices and projections of every layer; else as v1_synthetic.
Hardware:  accelerators; every device takes an equal part of the batch. Neither memory nor speed was measured.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   poem train ftl_meshtr_synthetic
"""

from dataclasses import replace

from poem_jax.experiments.v1_synthetic import config as v1
from poem_jax.models.presets import preset
from poem_jax.training.recipes import experiment

config = experiment(
    "ftl-meshtr",
    name="ftl_meshtr_synthetic",
    model=preset("ftl-meshtr"),
    data=v1.data,
    train=replace(v1.train, out="runs/ftl_meshtr_synthetic"),
)
