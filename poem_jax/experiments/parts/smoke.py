"""An experiment at a size that runs in seconds on a CPU: two steps of a thin model on stand-ins of its data.

It goes through the code that the real one goes through: readers, augmentation, workers, loss, checkpoints,
validation, pictures. It says that the experiment starts, and nothing of how well it learns, how much memory
it takes, or whether the files of its data are sound: it reads none of them.
"""

from dataclasses import replace
from pathlib import Path

import jax

from poem_jax.data.released_sets import of_split
from poem_jax.data.shards import expand_shards
from poem_jax.data.tar_labels import convention_of
from poem_jax.experiments.parts.small_models import NUM_VIEWS, small, with_joint_decoder
from poem_jax.miniatures import captures, released_tars
from poem_jax.miniatures.mano_stand_in import write_mano
from poem_jax.miniatures.names import WRITERS
from poem_jax.mixture.config import (
    AnySource,
    ArcticSource,
    CapturesSource,
    DexYCBSource,
    FreiHANDSource,
    HO3DSource,
    InterHandSource,
    MixtureConfig,
    OakInkSource,
    Part,
    ReleasedTarsSource,
    SyntheticSource,
)
from poem_jax.models.apply import init
from poem_jax.models.config import Config, ModelConfig
from poem_jax.training.config import BatchShape, DataConfig, RunConfig, TrainConfig
from poem_jax.weights.store import save

STEPS = 2
_SAMPLES = 8
"""Of a batch, at least; 1, 2, 4 and 8 devices can share it."""
_RAW = {
    DexYCBSource: "dexycb",
    OakInkSource: "oakink",
    ArcticSource: "arctic",
    InterHandSource: "interhand",
    FreiHANDSource: "freihand",
}


def smoke(config: TrainConfig, folder: Path) -> TrainConfig:
    """Return a tiny likeness of an experiment, and write what it needs.

    Args:
        config: the experiment.
        folder: empty; gets stand-ins of the data sets, weights to start from, and the run.

    Raises:
        ValueError: tars whose names say no data set.
        FileNotFoundError: a folder or a pattern with `*` that stands for no tar.
    """
    model = small(config.model)
    if isinstance(model, Config) and model.joint_decoder is not None:
        model = with_joint_decoder(model)
    train = config.train
    shared_by = train.host_devices * config.compute.accumulate
    begun = train.init_from or train.first_stage_from
    weights = None if begun is None else _write_weights(model, folder / "weights")
    return replace(
        config,
        model=model,
        data=_data(config.data, model, folder, -(-_SAMPLES // shared_by) * shared_by),
        first_stage_steps=min(config.first_stage_steps, 1),
        optimizer=replace(config.optimizer, warmup_steps=min(config.optimizer.warmup_steps, 1)),
        train=RunConfig(
            steps=STEPS,
            seed=train.seed,
            out=str(folder / "run"),
            init_from=weights if train.init_from else None,
            first_stage_from=weights if train.first_stage_from else None,
            smooth_queries=train.smooth_queries,
            log_every=1,
            checkpoint_every=1,
            keep_best=train.keep_best,
            skip_bad_steps=train.skip_bad_steps,
            panel_every=STEPS if train.panel_every else 0,
            validate_every=STEPS if train.validate_every else 0,
            validation_samples=2,
            validation_views=(NUM_VIEWS,),
            host_devices=train.host_devices,
            data_parallel=train.data_parallel,
            tensorboard=train.tensorboard,
            progress=False,
        ),
    )


def _data(data: DataConfig, model: ModelConfig, folder: Path, samples: int) -> DataConfig:
    synthetic = replace(
        data.synthetic,
        image_hw=model.image_hw,
        num_views=NUM_VIEWS,
        supersample=1,
        num_backgrounds=2,
    )
    least = min((shape.min_views or NUM_VIEWS for shape in data.batches), default=NUM_VIEWS)
    shape = BatchShape(NUM_VIEWS, samples, None if data.mixture else min(least, NUM_VIEWS))
    mixture = None if data.mixture is None else _mixture(data.mixture, folder)
    return replace(data, synthetic=synthetic, batches=(shape,), prefetch=2, workers=1, mixture=mixture)


def _mixture(mixture: MixtureConfig, folder: Path) -> MixtureConfig:
    mano = str(write_mano(folder / "MANO_RIGHT.pkl"))
    parts = tuple(
        Part(
            _stand_in(part.source, folder, mano),
            part.weight,
            part.views,
            # Shards of a stand-in hold a sample each, of which no share can be taken.
            0.5 if part.held_out and isinstance(part.source, CapturesSource) else 0.0,
        )
        for part in mixture.parts
    )
    return replace(mixture, parts=parts, processes=min(mixture.processes, 1))


def _stand_in(source: AnySource, folder: Path, mano: str) -> AnySource:
    """Write the stand-in of a source's files and return the source that reads them."""
    if isinstance(source, SyntheticSource):
        return source
    if isinstance(source, CapturesSource):
        captures.write(folder / "capture")
        return CapturesSource((str(folder / "capture"),))
    if isinstance(source, ReleasedTarsSource):
        shard = of_split(expand_shards(source.paths), source.split)[0]
        name = convention_of(shard.name).name.lower()
        WRITERS[f"tars-{name}"](folder / "tars")
        shards = f"{folder}/tars/{released_tars.KINDS[name].train}-{{000000..000001}}.tar"
        return ReleasedTarsSource((shards,), mano=mano if source.mano else None)
    name = f"ho3d-{source.version}" if isinstance(source, HO3DSource) else _RAW[type(source)]
    WRITERS[name](folder / name)
    return replace(source, root=str(folder / name), mano=mano)


def _write_weights(model: ModelConfig, folder: Path) -> str:
    save(folder, model, init(model, key=jax.random.key(0)))
    return str(folder)
