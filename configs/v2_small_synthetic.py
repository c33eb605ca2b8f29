"""POEM v2-small (width 128) with the paper's recipe, on endless synthetic captures at 256 x 256.

What:      as configs/v2_base_synthetic.py, with another model.
Hardware:  as there.
Time:      not run to its end here.
Expected:  no number of ours yet.
Command:   python train.py configs/v2_small_synthetic.py
"""

from dataclasses import replace

from configs.v2_base_synthetic import config as base
from poem_jax.models.presets import preset

config = replace(
    base,
    name="v2_small_synthetic",
    model=preset("v2-small"),
    train=replace(base.train, out="runs/v2_small_synthetic"),
)
