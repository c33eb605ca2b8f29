"""POEM v1 and the baselines by the release's own recipe, where it differs from the paper: one data set each.

What:      as v1_paper, but the released models; every gradient tensor clipped on its own; the rate drops at
           epoch 70 (FTL-MeshTR: 32) of 101 (PE-MeshTR on DexYCB: 100); batch 32 (HO3D: 16); the release's
           augmentation. Names: v1, mvp, pe-meshtr, ftl-meshtr on dexycb, oakink, ho3d.
Data:      as there.
Hardware:  one accelerator.
Time:      not measured here. 80,093 steps on DexYCB, 57,267 on HO3D, 185,234 on OakInk.
Expected:  the numbers of v1_paper; the release has none of its own here.
Command:   poem train v1_release
           is v1 on DexYCB; poem train v1_release:mvp-ho3d another.
"""

from poem_jax.data.augmentation_recipes import RELEASE_V1
from poem_jax.experiments.parts.single_sets import on_one_set
from poem_jax.models.presets import DATASETS, released
from poem_jax.training.config import TrainConfig


def _on(name: str, model: str, dataset: str) -> TrainConfig:
    return on_one_set(
        name,
        released(model, dataset=dataset),
        dataset,
        RELEASE_V1,
        epochs=100 if (model, dataset) == ("pe-meshtr", "dexycb") else 101,
        drop_epoch=32 if model == "ftl-meshtr" else 70,
        batch_size=16 if dataset == "ho3d" else 32,
    )


configs = {
    f"{model}-{dataset}": _on(f"v1_release_{model}-{dataset}", model, dataset)
    for model in ("v1", "mvp", "pe-meshtr", "ftl-meshtr")
    for dataset in DATASETS
}
config = _on("v1_release", "v1", "dexycb")
