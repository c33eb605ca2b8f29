"""One of POEM v1's systems on one data set, which `v1_paper` and `v1_release` name all of."""

from dataclasses import replace
from functools import singledispatch

from poem_jax.data.augmentation_recipes import Recipe
from poem_jax.experiments.parts.data_sets import SETS, one_set
from poem_jax.experiments.v1_synthetic import config as synthetic
from poem_jax.models.config import Design, ModelConfig
from poem_jax.models.mesh_transformer_config import CanonicalFusion, MeshTransformerConfig
from poem_jax.models.mvp_config import MvpConfig
from poem_jax.models.poem_v1_config import PoemV1Config, in_cuboid
from poem_jax.models.presets import CUBOIDS
from poem_jax.training.config import BatchShape, TrainConfig
from poem_jax.training.recipes import experiment, recipe_of


def on_one_set(
    name: str,
    model: ModelConfig,
    dataset: str,
    recipe: Recipe,
    *,
    epochs: int,
    drop_epoch: int,
    batch_size: int,
) -> TrainConfig:
    """Return a system's recipe on one data set with all its cameras.

    Args:
        name: of the experiment.
        model: of POEM v1 or a baseline; one of the paper's is put where that set's hands are.
        dataset: "dexycb", "oakink" or "ho3d".
        recipe: of augmentation.
        epochs: whole ones, of whole batches.
        drop_epoch: after how many of them the rate becomes a tenth.
        batch_size: samples of a step.
    """
    of = SETS[dataset]
    model = _made_for(model, dataset, of.most_views)
    by = recipe_of(model)
    return experiment(
        by.name,
        name=name,
        model=model,
        data=replace(
            synthetic.data,
            batches=(BatchShape(num_views=of.most_views, batch_size=batch_size),),
            mixture=one_set(dataset, recipe),
        ),
        train=replace(
            synthetic.train,
            steps=epochs * (of.frames // batch_size),
            out=f"runs/{name}",
            validation_views=(of.most_views,),
        ),
        optimizer=replace(by.optimizer, drop_at=drop_epoch / epochs),
    )


@singledispatch
def _made_for(model: ModelConfig, dataset: str, num_views: int) -> ModelConfig:
    raise NotImplementedError(f"say here how a {type(model).__name__} is made for a data set")


@_made_for.register
def _(model: PoemV1Config, dataset: str, num_views: int) -> ModelConfig:
    return model if model.design is Design.RELEASE else in_cuboid(model, CUBOIDS[dataset])


@_made_for.register
def _(model: MeshTransformerConfig, dataset: str, num_views: int) -> ModelConfig:
    if model.design is Design.RELEASE:
        return model
    fusion = model.fusion
    if isinstance(fusion, CanonicalFusion):
        fusion = replace(fusion, num_views=num_views)
    return replace(model, cuboid=CUBOIDS[dataset], fusion=fusion)


@_made_for.register
def _(model: MvpConfig, dataset: str, num_views: int) -> ModelConfig:
    return replace(model, cuboid=CUBOIDS[dataset], num_views=num_views)
