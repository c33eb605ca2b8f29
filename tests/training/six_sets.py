"""A run on stand-ins of all six data sets and synthetic captures, small enough to be killed twenty times."""

from pathlib import Path

import jax

from poem_jax.data.augmentation_recipes import PAPER
from poem_jax.data.view_sampling import UniformViews
from poem_jax.losses import SYNTHETIC
from poem_jax.miniatures import released_tars
from poem_jax.miniatures.faults import drop_member
from poem_jax.mixture.config import MixtureConfig, Part, ReleasedTarsSource, SyntheticSource
from poem_jax.models.apply import init
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.training.config import BatchShape, DataConfig, OptimizerConfig, RunConfig, TrainConfig
from poem_jax.weights.store import save
from tests.training.conftest import HW, MICRO

VIEWS, BATCH, STEPS = 3, 4, 30
SHARES = {"dexycb": 0.16, "ho3d": 0.16, "oakink": 0.16, "arctic": 0.08, "interhand": 0.16, "freihand": 0.12}
"""Of the mixture; the rest is synthetic. ARCTIC's pictures are large."""
ONE_VIEW = "freihand"
"""The set that nothing of can be held out, since a hand is placed by two views or more."""
CORRUPT = "dexycb"
"""The set of whose first sample an image is missing."""


def write_sets(folder: Path) -> None:
    """Write one archive of three samples for every set, the last one to be held out, and first weights."""
    for name in SHARES:
        released_tars.write(name, folder / "sets", samples=3)
        shards = [shard(folder, name, number) for number in range(3)]
        members = [released_tars.members_of(path) for path in shards]
        for path in shards:
            path.unlink()
        shards[0].write_bytes(released_tars.archive(members[0] | members[1] | members[2]))
    save(folder / "weights", MICRO, init(MICRO, key=jax.random.key(0)))
    drop_member(shard(folder, CORRUPT, 0), "000000000.image_0.jpg")


def shard(folder: Path, name: str, number: int) -> Path:
    return folder / "sets" / f"{released_tars.KINDS[name].train}-{number:06d}.tar"


def experiment(folder: Path) -> TrainConfig:
    """Return the run on the sets in a folder."""
    parts = [
        Part(
            ReleasedTarsSource((str(shard(folder, name, 0)),)),
            share,
            UniformViews(),
            held_out=0.0 if name == ONE_VIEW else 0.34,
        )
        for name, share in SHARES.items()
    ]
    synthetic = Part(SyntheticSource(), 1.0 - sum(SHARES.values()), UniformViews())
    return TrainConfig(
        name="six_miniatures",
        model=MICRO,
        loss=SYNTHETIC,
        data=DataConfig(
            synthetic=SyntheticConfig(image_hw=HW, num_views=VIEWS, supersample=1, num_backgrounds=2),
            batches=(BatchShape(num_views=VIEWS, batch_size=BATCH),),
            mixture=MixtureConfig((*parts, synthetic), recipe=PAPER, max_corrupt_share=1.0, processes=1),
        ),
        optimizer=OptimizerConfig(learning_rate=1e-3, ema_decay=0.9, warmup_steps=2),
        train=RunConfig(
            steps=STEPS,
            out=str(folder / "run"),
            # Quicker than drawing them in every sitting.
            init_from=str(folder / "weights"),
            log_every=1,
            checkpoint_every=2,
            validate_every=STEPS,
            validation_samples=2,
            validation_views=(2,),
            progress=False,
        ),
    )
