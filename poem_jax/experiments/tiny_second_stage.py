"""Go on with the second stage of the shipped model, its first stage as it is.

What:      joint decoder and decoder of tiny_synthetic from the shipped weights, on other data (seed 4).
           Not the sittings that made them, which read stored maps (docs/shipped_model.md).
Hardware:  2 CPU cores at the lowest priority; the same command uses every GPU or TPU it finds.
Time:      20,000 steps of 16 captures; see docs/shipped_model.md for the rate. The same command goes on where
           the last one stopped.
Expected:  see docs/shipped_model.md.
Command:   poem train tiny_second_stage
Then:      poem train tiny_second_stage --export poem_jax/weights/tiny
"""

from dataclasses import replace

from poem_jax.experiments.tiny_continued import config as continued

config = replace(
    continued,
    name="tiny_second_stage",
    data=replace(continued.data, seed=4),
    frozen_views=True,
    train=replace(continued.train, steps=20000, out="runs/tiny_second_stage", seed=2),
)
