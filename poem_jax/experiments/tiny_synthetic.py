"""The shipped model: preset `tiny` on endless synthetic captures of the benchmark distribution.

What:      1 to 8 views of 128 x 128, a kind of batch (2, 4 or 8 views) drawn anew every step. The first steps
           train trunk and heat maps alone; then all is trained, the second stage about the first one's own
           root. Absolute losses on every layer; averaged weights are evaluated and shipped.
Hardware:  2 CPU cores (two host devices, half a batch each); the same command uses every GPU or TPU it finds.
Time:      about an hour on two free cores; the same command goes on where the last one stopped.
Expected:  see docs/training.md (poem eval tiny_synthetic).
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
            BatchShape(num_views=2, batch_size=16, min_views=1, weight=0.15),
            BatchShape(num_views=4, batch_size=16, weight=0.7),
            BatchShape(num_views=8, batch_size=8, weight=0.15),
        ),
    ),
    loss=SYNTHETIC,
    first_stage_steps=3009,
    training_root=TrainingRoot(source=RootSource.TRIANGULATED),
    optimizer=OptimizerConfig(
        learning_rate=5e-4,
        first_stage_learning_rate=2e-3,
        warmup_steps=200,
        final_ratio=0.01,
        ema_decay=0.998,
    ),
    train=RunConfig(
        steps=4100,
        out="runs/tiny_synthetic",
        max_minutes=150.0,
        log_every=20,
        checkpoint_every=250,
        validate_every=700,
        validation_views=(4,),
        host_devices=2,
    ),
)
