"""POEM v2-large (width 512) with the paper's recipe, on endless synthetic captures at 256 x 256.

What:      as v2_base_synthetic, with another model.
Hardware:  as there.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   poem train v2_large_synthetic
"""

from dataclasses import replace

from poem_jax.experiments.v2_base_synthetic import config as base
from poem_jax.models.presets import preset

config = replace(
    base,
    name="v2_large_synthetic",
    model=preset("v2-large"),
    train=replace(base.train, out="runs/v2_large_synthetic"),
)
