"""POEM v2-param (its last layer regresses pose and shape) with the paper's recipe, on synthetic captures.

What:      as v2_base_synthetic, with another model.
Hardware:  as there.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   poem train v2_param_synthetic
"""

from dataclasses import replace

from poem_jax.experiments.v2_base_synthetic import config as base
from poem_jax.models.presets import preset

config = replace(
    base,
    name="v2_param_synthetic",
    model=preset("v2-param"),
    train=replace(base.train, out="runs/v2_param_synthetic"),
)
