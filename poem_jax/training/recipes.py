"""Named training recipes: loss, noise of the root, and optimiser that belong together.

`paper` supervises every layer; `release` does what the authors' code does: the last layer only, every
gradient tensor clipped on its own, noise shared by the batch, a tenfold drop of the rate at 70 %.
"""

from dataclasses import dataclass, replace
from typing import Any

from poem_jax import losses
from poem_jax.training.config import (
    PAPER_ROOT,
    RELEASE_ROOT,
    Clip,
    OptimizerConfig,
    Schedule,
    TrainConfig,
    TrainingRoot,
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
RECIPES = {recipe.name: recipe for recipe in (PAPER_RECIPE, RELEASE_RECIPE, RELEASE_MANO_RECIPE)}


def experiment(recipe: str, **rest: Any) -> TrainConfig:
    """Make an experiment that follows a recipe.

    Args:
        recipe: `"paper"`, `"release"` or, for the parametric model, `"release-mano"`.
        rest: the other fields of `TrainConfig`; one that the recipe sets may be given to replace it.

    Raises:
        ValueError: no recipe of that name.
    """
    if recipe not in RECIPES:
        raise ValueError(f"`recipe` must be one of {sorted(RECIPES)}; got {recipe!r}")
    chosen = RECIPES[recipe]
    fields = {"loss": chosen.loss, "training_root": chosen.training_root, "optimizer": chosen.optimizer}
    return TrainConfig(**{**fields, **rest})
