"""An experiment turned to another model or other data: what `poem train --init` and `--data` do."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from poem_jax.data.capture_folder import RIG_FILES, find_rig_file
from poem_jax.mixture.config import CapturesSource, FramesSource, MixtureConfig, Part, SyntheticSource
from poem_jax.mixture.recognise import Kind, recognise, source_at
from poem_jax.models.config import ModelConfig
from poem_jax.training.config import BatchShape, DataConfig, TrainConfig, predicts_parameters
from poem_jax.training.recipes import recipe_of
from poem_jax.weights.store import SHIPPED, read_config

MOST_VIEWS = 8
"""Of a batch whose number of views is taken from a capture; `data.batches` may ask for more."""


def start_from(config: TrainConfig, init: str) -> TrainConfig:
    """Return the experiment for the model in a folder, which the run starts from.

    The model is the folder's, whatever the experiment had. What belongs to a model comes with it: size and
    margin of crops, whether samples carry pose and shape, numbers of views that its layers are made for, loss
    and root of its recipe. Data, rates and bookkeeping stay.

    Args:
        config: the experiment.
        init: folder that `poem_jax.save`, `poem train --export` or `poem import-torch` wrote; `shipped` = the
            model of the package.

    Raises:
        FileNotFoundError: no such folder, or it has no config.
        ValueError: its config cannot be read, or the experiment cannot train such a model.
    """
    model = read_config(SHIPPED if init == "shipped" else Path(init))
    recipe = recipe_of(model)
    data = config.data
    crop = replace(data.synthetic.crop, expand_ratio=model.crop.ratio)
    views = [_views_for(model, count) for count in config.train.validation_views]
    return replace(
        config,
        model=model,
        data=replace(
            data,
            synthetic=replace(data.synthetic, image_hw=model.image_hw, crop=crop),
            batches=tuple(_batch_for(model, shape) for shape in data.batches),
            mixture=None if data.mixture is None else _mixture_for(model, data.mixture),
        ),
        loss=recipe.loss,
        training_root=recipe.training_root,
        first_stage_steps=config.first_stage_steps if model.triangulates else 0,
        train=replace(config.train, init_from=init, validation_views=tuple(dict.fromkeys(views))),
    )


def train_on(config: TrainConfig, paths: Sequence[str | Path], *, mano: Path | None = None) -> TrainConfig:
    """Return the experiment with the data at these paths in place of its data sets; synthetic captures stay.

    All captures together are one part, every other path is one of its own; views, share and held-out frames
    are those of the experiment's first data set. Batches get as many views as the captures have cameras, at
    most 8 and what the model is made for.

    Args:
        config: an experiment with a mixture.
        paths: captures with labels, folders of raw data sets, or tars; see `poem inspect`.
        mano: the user's MANO file, for data that need it.

    Raises:
        FileNotFoundError: nothing is there, or a capture lacks its rig, images or labels.
        ValueError: the experiment has no data set to replace, or a path is none of these.
    """
    mixture = config.data.mixture
    parts = () if mixture is None else mixture.parts
    like = next((part for part in parts if not isinstance(part.source, SyntheticSource)), None)
    if mixture is None or like is None:
        raise ValueError(
            f"--data stands for the data sets of an experiment's mixture; {config.name} has none. Take one "
            "that has, such as `finetune`"
        )
    kinds = [recognise(path) for path in paths]
    captures = tuple(str(path) for path, kind in zip(paths, kinds, strict=True) if kind is Kind.CAPTURE)
    sources: list[FramesSource] = [
        # A folder may hold shards of several splits; those that are trained on are meant.
        source_at(path, kind, split="train" if Path(path).is_dir() and kind is Kind.TARS else None, mano=mano)
        for path, kind in zip(paths, kinds, strict=True)
        if kind is not Kind.CAPTURE
    ]
    data = config.data
    if captures:
        source = CapturesSource(captures, mano=None if mano is None else str(mano))
        sources.insert(0, source)
        if len(sources) == 1:
            data = _with_views(data, config.model, source.open().max_views)
    kept = tuple(part for part in parts if isinstance(part.source, SyntheticSource))
    weight = (sum(part.weight for part in parts) - sum(part.weight for part in kept)) / len(sources)
    new = tuple(Part(source, weight, like.views, like.held_out) for source in sources)
    return replace(config, data=replace(data, mixture=replace(mixture, parts=(*new, *kept))))


def check_captures(config: TrainConfig) -> None:
    """Raise where an experiment names captures that are not there, as `finetune` does by itself.

    Raises:
        FileNotFoundError: no folder, or none with a rig.
    """
    parts = () if config.data.mixture is None else config.data.mixture.parts
    named = [part.source.folders for part in parts if isinstance(part.source, CapturesSource)]
    for folder in itertools.chain(*named):
        try:
            find_rig_file(folder)
        except FileNotFoundError:
            raise FileNotFoundError(
                f"{config.name} trains on the capture in {folder}, and there is none: give --data DIR ..., "
                f"your captures, each a folder with {' or '.join(RIG_FILES)}, images, and labels, which "
                "`poem fit` makes"
            ) from None


def _with_views(data: DataConfig, model: ModelConfig, cameras: int) -> DataConfig:
    count = _views_for(model, min(cameras, MOST_VIEWS, data.synthetic.num_views))
    return replace(data, batches=tuple(replace(shape, num_views=count) for shape in data.batches))


def _views_for(model: ModelConfig, count: int) -> int:
    """Return the nearest number of views that the model's layers are made for."""
    least, most = model.view_range
    return max(least, count if most is None else min(count, most))


def _batch_for(model: ModelConfig, shape: BatchShape) -> BatchShape:
    count = _views_for(model, shape.num_views)
    least = None if shape.min_views is None else min(shape.min_views, count)
    return replace(shape, num_views=count, min_views=least)


def _mixture_for(model: ModelConfig, mixture: MixtureConfig) -> MixtureConfig:
    recipe = replace(mixture.recipe, box_ratio=model.crop.ratio)
    return replace(mixture, recipe=recipe, pose=predicts_parameters(model))
