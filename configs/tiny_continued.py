"""Go on with the shipped model: all of it trained from its present weights, on captures it has not seen.

What:      the second stage of configs/tiny_synthetic.py from the shipped weights, on other data (seed 2).
Hardware:  2 CPU cores; the same command uses every GPU or TPU it finds.
Time:      about 150 minutes on two free cores; the same command goes on where the last one stopped.
Expected:  less than the table in README.md; not run to its end yet.
Command:   python train.py configs/tiny_continued.py
Then:      python train.py configs/tiny_continued.py --export poem_jax/weights/tiny
"""

from dataclasses import replace

from configs.tiny_synthetic import config as first

config = replace(
    first,
    name="tiny_continued",
    data=replace(first.data, seed=2),
    first_stage_steps=0,
    optimizer=replace(first.optimizer, learning_rate=1e-3),
    train=replace(
        first.train, steps=8000, out="runs/tiny_continued", init_from="poem_jax/weights/tiny", seed=1
    ),
)
