"""Named training recipes: loss, noise of the root, and optimiser that belong together.

`paper` supervises every layer; `release` does what the authors' code does: the last layer only, every
gradient tensor clipped on its own, noise shared by the batch, a tenfold drop of the rate at 70 %. These are
of POEM v2. POEM v1, its ablations and the baselines have the same losses in paper and release; the paper
drops the rate at 70 % of 100 epochs of batch 16, the release at epoch 70 (FTL-MeshTR: 32) of 101 (PE-MeshTR
of DexYCB: 100) with batches of 32 (HO3D: 16), every gradient tensor clipped on its own.

Training still differs from the authors' code in what belongs to PyTorch's layers:

- queries, keys and values of DETR's and MvP's attentions are one tensor (3 d, d) there and three here: the
  limit of the gradient's norm holds for each third, and Xavier's first weights span sqrt(6 / 2 d), not
  sqrt(6 / 4 d);
- convolutions begin with the variance 2 / fan-in, there 2 / fan-out;
- linear layers begin by Xavier everywhere, as the paper says of the transformer; there by PyTorch's default
  outside of DETR's decoder.

POEM v1 trains about the root that it triangulates, without noise: its queries start from the triangulated
joints, and its loss reaches the heat maps through them. The noisy true root is a matter of v2; a sample with
one view, which triangulates none, takes it in v1, too.
"""

from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

from poem_jax import losses
from poem_jax.models.config import Config, Design, ModelConfig, ResNetConfig
from poem_jax.models.mesh_transformer_config import CanonicalFusion, MeshTransformerConfig
from poem_jax.models.mvp_config import MvpConfig
from poem_jax.models.poem_v1_config import OneStageConfig, PoemV1Config
from poem_jax.training.config import (
    PAPER_ROOT,
    RELEASE_ROOT,
    Clip,
    OptimizerConfig,
    RootSource,
    Schedule,
    TrainConfig,
    TrainingRoot,
    predicts_parameters,
)


@dataclass(frozen=True)
class Recipe:
    """What of an experiment is neither model nor data nor bookkeeping."""

    name: str
    loss: losses.LossRecipe
    training_root: TrainingRoot
    optimizer: OptimizerConfig


PAPER_RECIPE = Recipe(
    "paper",
    losses.PAPER,
    PAPER_ROOT,
    OptimizerConfig(
        learning_rate=1e-4, schedule=Schedule.COSINE, final_ratio=0.001, clip=Clip.GLOBAL, clip_norm=1.0
    ),
)
RELEASE_RECIPE = Recipe(
    "release",
    losses.RELEASE,
    RELEASE_ROOT,
    OptimizerConfig(
        learning_rate=1e-4, schedule=Schedule.STEP, drop_at=0.7, clip=Clip.PER_TENSOR, clip_norm=1.0
    ),
)
RELEASE_MANO_RECIPE = replace(
    RELEASE_RECIPE,
    name="release-mano",
    optimizer=replace(RELEASE_RECIPE.optimizer, schedule=Schedule.COSINE, final_ratio=0.001),
)
"""The released parametric model had a cosine down to 1e-7."""


_OWN_ROOT = TrainingRoot(source=RootSource.TRIANGULATED)
_RELEASED_V1_ROOT = TrainingRoot(source=RootSource.TRIANGULATED, max_error_m=None)
"""The released losses are plain means over all samples."""


def _with_steps(
    name: str, loss: losses.LossRecipe, drop_at: float, clip: Clip, root: TrainingRoot = PAPER_ROOT
) -> Recipe:
    """Adam with one tenfold drop of the rate. `root` is of no account for models that have none."""
    optimizer = OptimizerConfig(
        learning_rate=1e-4, schedule=Schedule.STEP, drop_at=drop_at, clip=clip, clip_norm=1.0
    )
    return Recipe(name, loss, root, optimizer)


V1_RECIPES = (
    _with_steps("v1", losses.V1, 0.7, Clip.GLOBAL, _OWN_ROOT),
    _with_steps("v1-1stage", losses.V1_ONE_STAGE, 0.7, Clip.GLOBAL),
    _with_steps("pe-meshtr", losses.MESH_TRANSFORMER, 0.7, Clip.GLOBAL),
    _with_steps("ftl-meshtr", losses.MESH_TRANSFORMER, 0.7, Clip.GLOBAL),
    _with_steps("mvp", losses.MVP, 0.7, Clip.GLOBAL),
    _with_steps("v1-release", losses.V1, 70 / 101, Clip.PER_TENSOR, _RELEASED_V1_ROOT),
    _with_steps("pe-meshtr-release", losses.MESH_TRANSFORMER, 70 / 100, Clip.PER_TENSOR),
    _with_steps("ftl-meshtr-release", losses.MESH_TRANSFORMER, 32 / 101, Clip.PER_TENSOR),
    _with_steps("mvp-release", losses.MVP, 70 / 101, Clip.PER_TENSOR),
)
"""POEM v1 (also its ablations of two stages), and the baselines. The paper does not mention clipping; its
recipes clip as `paper` does. Where one data set has another number of epochs, its experiment says so."""
SYNTHETIC_RECIPE = Recipe(
    "synthetic",
    losses.SYNTHETIC,
    _OWN_ROOT,
    OptimizerConfig(learning_rate=1e-3, warmup_steps=200, final_ratio=0.005, ema_decay=0.998),
)
"""Of our own models on the small trunk, `tiny` and `v2-nano`."""
RECIPES = {
    recipe.name: recipe
    for recipe in (PAPER_RECIPE, RELEASE_RECIPE, RELEASE_MANO_RECIPE, SYNTHETIC_RECIPE, *V1_RECIPES)
}


def recipe_of(model: ModelConfig) -> Recipe:
    """Return the recipe that a model is trained by, as the table of `docs/models.md` has it."""
    return RECIPES[_recipe_name(model)]


@singledispatch
def _recipe_name(model: ModelConfig) -> str:
    raise NotImplementedError(f"say here which recipe a {type(model).__name__} is trained by")


@_recipe_name.register
def _(model: Config) -> str:
    if isinstance(model.backbone, ResNetConfig):
        return "synthetic"
    if model.decoder.layer is Design.PAPER:
        return "paper"
    return "release-mano" if predicts_parameters(model) else "release"


@_recipe_name.register
def _(model: PoemV1Config) -> str:
    if isinstance(model.first_stage, OneStageConfig):
        return "v1-1stage"
    return _of_design("v1", model.design)


@_recipe_name.register
def _(model: MeshTransformerConfig) -> str:
    own_points = isinstance(model.fusion, CanonicalFusion)
    return _of_design("ftl-meshtr" if own_points else "pe-meshtr", model.design)


@_recipe_name.register
def _(model: MvpConfig) -> str:
    return _of_design("mvp", model.design)


def _of_design(name: str, design: Design) -> str:
    return name if design is Design.PAPER else f"{name}-release"


def experiment(recipe: str, **rest: Any) -> TrainConfig:
    """Make an experiment that follows a recipe.

    Args:
        recipe: `"paper"`, `"release"`, `"release-mano"` for the parametric model, `"synthetic"` for `tiny`
            and `v2-nano`, or one of POEM v1 and the baselines, such as `"v1"` or `"mvp-release"`.
        rest: the other fields of `TrainConfig`; one that the recipe sets may be given to replace it.

    Raises:
        ValueError: no recipe of that name.
    """
    if recipe not in RECIPES:
        raise ValueError(f"`recipe` must be one of {sorted(RECIPES)}; got {recipe!r}")
    chosen = RECIPES[recipe]
    fields = {"loss": chosen.loss, "training_root": chosen.training_root, "optimizer": chosen.optimizer}
    return TrainConfig(**{**fields, **rest})
