"""POEM v1 with the paper's recipe, on endless synthetic captures at 256 x 256.

What:      ResNet-34 trunk, width 256, six layers; 8 views a sample; losses of heat maps, triangulated joints
           and every layer; Adam 1e-4, a tenth of it after 70 %, a global clip at 1; batch 16, and as many
           steps as 100 epochs of DexYCB-Mv's 25,387 frames have. The paper starts the trunk from ImageNet:
           `--train.first-stage-from DIR` (docs/weights.md).
Hardware:  accelerators; every device takes an equal part of the batch (`--data.batches.0.batch-size` shrinks
           it). Neither memory nor speed was measured.
Time:      not run to its end here.
Expected:  no number of ours yet; after an export the benchmark's table comes from
           poem eval v1_synthetic --checkpoint DIR --views 2,4,8 (one view does not fix the root).
Command:   poem train v1_synthetic
"""

from dataclasses import replace

from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.models.presets import preset
from poem_jax.training.config import BatchShape, DataConfig, RunConfig
from poem_jax.training.recipes import experiment

config = experiment(
    "v1",
    name="v1_synthetic",
    model=preset("v1"),
    data=DataConfig(
        synthetic=replace(
            benchmark,
            image_hw=(256, 256),
            crop=replace(benchmark.crop, expand_ratio=preset("v1").crop.ratio),
        ),
        seed=1,
        batches=(BatchShape(num_views=8, batch_size=16),),
        workers=8,
        prefetch=8,
    ),
    train=RunConfig(
        steps=158_600, out="runs/v1_synthetic", log_every=50, checkpoint_every=1000, validate_every=2000
    ),
)
