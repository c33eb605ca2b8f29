"""`v2-nano`, the paper's v2 structure on a small trunk, on the captures of tiny_synthetic.

What:      sigmoid heat maps of the release's 21 joints, of which only the root is used; the template first;
           three layers, each with the nearest basis points anew. Samples, losses and rates of tiny_synthetic.
Hardware:  as there.
Time:      not run to its end here. The figures of docs/shipped_model.md are of 2,300 steps beside the shipped
           model; those weights do not ship.
Expected:  see docs/shipped_model.md.
Command:   poem train v2_nano_synthetic
"""

from dataclasses import replace

from poem_jax.experiments.tiny_synthetic import config as tiny
from poem_jax.models.presets import preset

config = replace(
    tiny,
    name="v2_nano_synthetic",
    model=preset("v2-nano"),
    train=replace(tiny.train, out="runs/v2_nano_synthetic"),
)
