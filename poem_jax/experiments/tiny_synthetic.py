"""The shipped model: preset `tiny` on endless synthetic captures of the benchmark distribution.

What:      1 to 8 views of 128 x 128, a kind of batch drawn anew every step. The first steps train trunk and
           heat maps alone; then all is trained, the second stage about the first one's own root. Absolute
           losses on every layer; averaged weights are evaluated and shipped.
Hardware:  a GPU beside many CPU cores that draw the captures; the same command uses what it finds.
Time:      two days on 2 CPU cores, by its rate there; not run to its end. The shipped weights come from six
           sittings by scripts around the same modules (docs/shipped_model.md).
Expected:  see docs/shipped_model.md (poem eval tiny_synthetic --stages).
Command:   poem train tiny_synthetic
Then:      poem train tiny_synthetic --export poem_jax/weights/tiny

The training seed is 1; validation draws from seed 424242, the bundled demo from 0, tables from others.
"""

from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.losses import SYNTHETIC
from poem_jax.models.presets import preset
from poem_jax.training.config import (
    BatchShape,
    DataConfig,
    OptimizerConfig,
    RootSource,
    RunConfig,
    TrainConfig,
    TrainingRoot,
)

config = TrainConfig(
    name="tiny_synthetic",
    model=preset("tiny"),
    data=DataConfig(
        synthetic=benchmark,
        seed=1,
        batches=(
            BatchShape(num_views=4, batch_size=64, min_views=1, weight=0.3),
            BatchShape(num_views=4, batch_size=64, weight=0.53),
            BatchShape(num_views=8, batch_size=32, min_views=5, weight=0.17),
        ),
    ),
    loss=SYNTHETIC,
    first_stage_steps=1700,
    training_root=TrainingRoot(source=RootSource.TRIANGULATED),
    optimizer=OptimizerConfig(
        learning_rate=1e-3,
        first_stage_learning_rate=2e-3,
        warmup_steps=200,
        final_ratio=0.005,
        ema_decay=0.998,
    ),
    train=RunConfig(
        steps=11000,
        out="runs/tiny_synthetic",
        log_every=20,
        checkpoint_every=500,
        validate_every=2000,
        validation_views=(4,),
        host_devices=2,
    ),
)
