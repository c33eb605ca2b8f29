"""POEM v2-base with the paper's recipe, on endless synthetic captures at 256 x 256.

What:      HRNet-W40 trunk, width 256, three layers; 1 to 8 views a sample; the release's losses on every
           layer; Adam 1e-4 with cosine decay and a global clip at 1; batch 32, 10 x 210,000 samples.
Hardware:  accelerators; every device takes an equal part of the batch (`--data.batches.0.batch-size` shrinks
           it). Neither memory nor speed was measured.
Time:      not run to its end here; the paper's runs see the same 2.1 million samples.
Expected:  no number of ours yet; after an export the benchmark's table comes from
           poem eval v2_base_synthetic --checkpoint DIR.
Command:   poem train v2_base_synthetic
"""

from dataclasses import replace

from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.models.presets import preset
from poem_jax.training.config import BatchShape, DataConfig, RunConfig
from poem_jax.training.recipes import experiment

config = experiment(
    "paper",
    name="v2_base_synthetic",
    model=preset("v2-base"),
    data=DataConfig(
        synthetic=replace(
            benchmark,
            image_hw=(256, 256),
            crop=replace(benchmark.crop, expand_ratio=preset("v2-base").crop.ratio),
        ),
        seed=1,
        batches=(BatchShape(num_views=8, batch_size=32, min_views=1),),
        workers=8,
        prefetch=8,
    ),
    train=RunConfig(
        steps=65_625, out="runs/v2_base_synthetic", log_every=50, checkpoint_every=1000, validate_every=2000
    ),
)
