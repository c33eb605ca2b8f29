"""The released models of POEM v2 on the paper's six data sets by the release's recipe, at 256 x 256.

What:      `v2_medium_release_synthetic`'s model, losses and optimiser (the rate a tenth after 70 % of the
           run, every gradient tensor clipped on its own); 0.18 of the samples from each of
           DexYCB, HO3D, OakInk, ARCTIC and InterHand2.6M, 0.10 from FreiHAND (one view); the release's
           augmentation and its draw of views, N(4, 2) held to 1 .. what the set has; batch 32, 10 x 210,000
           samples. The others by name: v2-small-release, v2-large-release, and v2-medium-mano-release, which
           regresses pose and shape, and whose rate falls to 1e-7 by a cosine. The paper's recipe is
           v2_base_six_sets and its kin.
Data:      the authors' tars in data/dataset_tars/ (poem_jax/experiments/parts/data_sets.py);
           v2-medium-mano-release reads raw sets, for OakInk's tars have no poses.
Hardware:  accelerators; every device takes an equal part of the batch. Eight worker processes decode
           (`--data.mixture.processes`). Neither memory nor speed was measured.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   poem train v2_medium_six_sets
           is the medium model; poem train v2_medium_six_sets:v2-small-release another.
"""

from dataclasses import replace

from poem_jax.data.augmentation_recipes import RELEASE_V2
from poem_jax.experiments.parts.data_sets import six_sets
from poem_jax.experiments.v2_medium_release_synthetic import config as synthetic
from poem_jax.models.presets import preset
from poem_jax.training.config import BatchShape, TrainConfig
from poem_jax.training.recipes import experiment, recipe_of


def _on(name: str, model: str, *, raw: bool = False) -> TrainConfig:
    of = preset(model)
    return experiment(
        recipe_of(of).name,
        name=name,
        model=of,
        data=replace(
            synthetic.data,
            batches=(BatchShape(num_views=8, batch_size=32),),
            mixture=six_sets(RELEASE_V2, raw=raw, by_release=True),
        ),
        train=replace(synthetic.train, out=f"runs/{name}"),
    )


configs = {
    "v2-small-release": _on("v2_small_release_six_sets", "v2-small-release"),
    "v2-large-release": _on("v2_large_release_six_sets", "v2-large-release"),
    "v2-medium-mano-release": _on("v2_medium_mano_release_six_sets", "v2-medium-mano-release", raw=True),
}
config = _on("v2_medium_six_sets", "v2-medium-release")
