"""The checkpoints of the tables: their names, and how each is made."""

from poem_jax.tables.row import Checkpoint

_RELEASED_V1 = {
    name: name for name in ("v1", "mvp", "pe-meshtr", "ftl-meshtr", "v1-wo-proj", "v1-g-emb", "v1-gv-emb")
}
"""Variants of `poem import-torch`, by preset; the authors released no other."""
_V2 = {
    "v2-small": ("v2_small_six_sets", "v2-small", "small.pth.tar"),
    "v2-base": ("v2_base_six_sets", "v2-medium", "medium.pth.tar"),
    "v2-large": ("v2_large_six_sets", "v2-large", "large.pth.tar"),
    "v2-param": ("v2_param_six_sets", "v2-medium-mano", "medium_MANO.pth.tar"),
}
"""Experiment, variant and released file, by preset."""
_MEAN_ROOT = " --model.first-stage.origin X Y Z"
"""Of the training set: docs/models.md."""


def v1(preset: str, dataset: str) -> Checkpoint:
    """Return the checkpoint of POEM v1, an ablation or a baseline, trained on one set (`dexycb`)."""
    ways = [_trained(f"v1_paper:{preset}-{dataset}", _MEAN_ROOT if preset == "v1-1stage" else "")]
    if preset in _RELEASED_V1:
        ways.append(
            f"poem import-torch FILE --variant {_RELEASED_V1[preset]} --dataset {dataset} --mano {{mano}} "
            "--out {out}   (FILE: a checkpoint of github.com/lixiny/POEM)"
        )
    return Checkpoint(f"{preset}-{dataset}", preset, tuple(ways))


def v2(preset: str) -> Checkpoint:
    """Return the checkpoint of a POEM v2, trained on the six sets."""
    experiment, variant, file = _V2[preset]
    released = (
        f"poem import-torch {file} --variant {variant} --mano {{mano}} --assets POEM-v2/assets --out {{out}}"
        "   (from the README of github.com/JubSteven/POEM-v2)"
    )
    return Checkpoint(preset, preset, (_trained(experiment), released))


def _trained(experiment: str, options: str = "") -> str:
    start = f"poem train {experiment}{options} --train.first-stage-from IMAGENET"
    return f"{start}; then the same with --export {{out}}   (IMAGENET: the paper's trunk, docs/weights.md)"
