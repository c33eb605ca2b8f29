"""The released medium model on the paper's six data sets by the release's recipe, at 256 x 256.

What:      `v2_medium_release_synthetic`'s model, losses and optimiser; 0.18 of the samples from each of
           DexYCB, HO3D, OakInk, ARCTIC and InterHand2.6M, 0.10 from FreiHAND (one view); the release's
           augmentation and its draw of views, N(4, 2) held to 1 .. what the set has; batch 32, 10 x 210,000
           samples. The paper's recipe is v2_base_six_sets and its kin.
Data:      the authors' tars in data/dataset_tars/ (poem_jax/experiments/parts/data_sets.py).
Hardware:  accelerators; every device takes an equal part of the batch. Eight worker processes decode
           (`--data.mixture.processes`). Neither memory nor speed was measured.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   poem train v2_medium_six_sets
"""

from dataclasses import replace

from poem_jax.data.augmentation_recipes import RELEASE_V2
from poem_jax.experiments.parts.data_sets import six_sets
from poem_jax.experiments.v2_medium_release_synthetic import config as synthetic
from poem_jax.training.config import BatchShape

config = replace(
    synthetic,
    name="v2_medium_six_sets",
    data=replace(
        synthetic.data,
        batches=(BatchShape(num_views=8, batch_size=32),),
        mixture=six_sets(RELEASE_V2, by_release=True),
    ),
    train=replace(synthetic.train, out="runs/v2_medium_six_sets"),
)
