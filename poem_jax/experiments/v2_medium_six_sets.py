"""The released medium model on the paper's six data sets, from the authors' packed tars, at 256 x 256.

What:      `v2_medium_release_synthetic`'s model, losses and optimiser; 0.18 of the samples from each of
           DexYCB, HO3D, OakInk, ARCTIC and InterHand2.6M, 0.10 from FreiHAND (one view); the release's
           augmentation and its draw of views, N(4, 2) held to 1 .. what the set has; batch 32, 10 x 210,000
           samples. The tars are looked for in data/dataset_tars/, where the release has them: start where
           that folder is, or copy this file and change TARS.
Hardware:  accelerators; every device takes an equal part of the batch. Eight worker processes decode
           (`--data.mixture.processes`). Neither memory nor speed was measured.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   poem train v2_medium_six_sets
"""

from dataclasses import replace

from poem_jax.data.augmentation_recipes import RELEASE_V2
from poem_jax.data.view_sampling import ReleaseNormalViews
from poem_jax.experiments.v2_medium_release_synthetic import config as synthetic
from poem_jax.mixture.config import MixtureConfig, Part, ReleasedTarsSource
from poem_jax.training.config import BatchShape

TARS = "data/dataset_tars"
_SHARDS = (
    ("DexYCB_mv/DexYCB_mv_train-{000000..000019}.tar", 0.18, 8),
    ("HO3D_mv/HO3D_mv_train-{000000..000008}.tar", 0.18, 5),
    ("Oakink_mv/Oakink_mv_train+val-{000000..000103}.tar", 0.18, 4),
    ("Arctic_mv/Arctic_mv_train_p1-{000000..000360}.tar", 0.18, 8),
    ("Interhand_mv/Interhand_mv_train-{000000..000075}.tar", 0.18, 8),
    ("Freihand_mv/Freihand_mv_train-{000000..000004}.tar", 0.10, 1),
)
"""Pattern, weight, most views."""

config = replace(
    synthetic,
    name="v2_medium_six_sets",
    data=replace(
        synthetic.data,
        batches=(BatchShape(num_views=8, batch_size=32),),
        mixture=MixtureConfig(
            parts=tuple(
                Part(ReleasedTarsSource((f"{TARS}/{shards}",)), weight, ReleaseNormalViews(1, most))
                for shards, weight, most in _SHARDS
            ),
            recipe=RELEASE_V2,
            processes=8,
        ),
    ),
    train=replace(synthetic.train, out="runs/v2_medium_six_sets"),
)
