"""POEM v1, its ablations and the baselines as the paper trains them: one data set each, at 256 x 256.

What:      all cameras in their own order (DexYCB 8, HO3D 5, OakInk 4); the paper's augmentation; Adam 1e-4, a
           tenth of it after 70 % of 100 epochs of batch 16. The trunk, ResNet-34, starts from ImageNet in the
           paper: `--train.first-stage-from DIR` with a file that you bring (docs/weights.md).
           The rest by name, MODEL-SET:
           v1, mvp, pe-meshtr, ftl-meshtr on dexycb, oakink, ho3d; v1-1stage on dexycb; v1-wo-proj on all
           three; v1-wo-pt on dexycb, ho3d; v1-g-emb, v1-gv-emb on oakink. v1-1stage wants the mean root of
           its set (docs/models.md); the preset's is a guess.
Data:      the authors' tars in data/dataset_tars/ (poem_jax/experiments/parts/data_sets.py).
Hardware:  accelerators; what must stay on one is refused before the first step.
Time:      the paper does not say; not measured here. 158,600 steps on DexYCB, 56,700 on HO3D, 366,800 on
           OakInk.
Expected:  the paper's MPVPE in mm, tables of the main experiments and of the ablations, on DexYCB, OakInk and
           HO3D: v1 6.13, 6.20, 17.20; mvp 9.77, 9.69, 20.95; pe-meshtr 7.41, 8.34, 23.49; ftl-meshtr 8.75,
           9.28, 24.15; v1-wo-proj 6.57, 6.42, 18.83; v1-1stage 9.42 on DexYCB; v1-wo-pt 7.63 on DexYCB, 19.26
           on HO3D; v1-g-emb 6.25 and v1-gv-emb 6.23 on OakInk. No number of ours yet.
Command:   poem train v1_paper
           is v1 on DexYCB; poem train v1_paper:mvp-ho3d another.
"""

from poem_jax.data.augmentation_recipes import PAPER
from poem_jax.experiments.parts.single_sets import on_one_set
from poem_jax.models.presets import preset
from poem_jax.training.config import TrainConfig

_SETS_OF_MODELS = {
    **dict.fromkeys(("v1", "mvp", "pe-meshtr", "ftl-meshtr", "v1-wo-proj"), ("dexycb", "oakink", "ho3d")),
    "v1-1stage": ("dexycb",),
    "v1-wo-pt": ("dexycb", "ho3d"),
    "v1-g-emb": ("oakink",),
    "v1-gv-emb": ("oakink",),
}


def _on(name: str, model: str, dataset: str) -> TrainConfig:
    return on_one_set(name, preset(model), dataset, PAPER, epochs=100, drop_epoch=70, batch_size=16)


configs = {
    f"{model}-{dataset}": _on(f"v1_paper_{model}-{dataset}", model, dataset)
    for model, datasets in _SETS_OF_MODELS.items()
    for dataset in datasets
}
config = _on("v1_paper", "v1", "dexycb")
