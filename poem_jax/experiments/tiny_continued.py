"""Go on with the shipped model on captures that it has not seen: heat maps first, then all of it.

What:      both stages of tiny_synthetic from the shipped weights, on other data (seed 2).
Hardware:  2 CPU cores; the same command uses every GPU or TPU it finds.
Time:      about an hour on two free cores; the same command goes on where the last one stopped.
Expected:  see docs/training.md.
Command:   poem train tiny_continued
Then:      poem train tiny_continued --export poem_jax/weights/tiny
"""

from dataclasses import replace

from poem_jax.experiments.tiny_synthetic import config as first

config = replace(
    first,
    name="tiny_continued",
    data=replace(first.data, seed=2),
    first_stage_steps=2400,
    optimizer=replace(first.optimizer, learning_rate=5e-4, first_stage_learning_rate=1e-3),
    train=replace(first.train, steps=4000, out="runs/tiny_continued", init_from="shipped", seed=1),
)
