"""Go on with the shipped model on captures that it has not seen.

What:      all of tiny_synthetic from the shipped weights, on other data (seed 3) and a lower rate.
Hardware:  2 CPU cores at the lowest priority; the same command uses every GPU or TPU it finds.
Time:      40,000 steps of 16 captures, a day and a half on two free cores (about 5 captures a second), the
           rate then having run out; the same command goes on where the last one stopped.
Expected:  see docs/shipped_model.md.
Command:   poem train tiny_continued
Then:      poem train tiny_continued --export poem_jax/weights/tiny
"""

from dataclasses import replace

from poem_jax.experiments.tiny_synthetic import config as first

config = replace(
    first,
    name="tiny_continued",
    data=replace(
        first.data,
        seed=3,
        batches=tuple(replace(b, batch_size=b.batch_size // 4) for b in first.data.batches),
    ),
    first_stage_steps=0,
    optimizer=replace(first.optimizer, learning_rate=2e-4),
    train=replace(first.train, steps=40000, out="runs/tiny_continued", init_from="shipped", seed=1),
)
