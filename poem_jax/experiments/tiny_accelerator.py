"""`tiny_continued` in batches that fill a GPU; `make accelerator` trains it.

What:      as there, in an eighth of the steps of eight times the captures: as many in all. The rate is that
           of the last sitting on a GPU (docs/shipped_model.md).
Hardware:  a GPU beside many CPU cores that draw the captures: `make accelerator MINUTES=10`, which has a
           process for each (docs/training.md). The command below draws them by threads.
Time:      5,000 steps, 585,600 captures (17 % of the batches are of 64, the others of 128), computed: 20
           minutes at the 500 captures a second of the sittings.
Expected:  see docs/shipped_model.md; no number of ours yet.
Command:   poem train tiny_accelerator
Then:      poem train tiny_accelerator --export DIR
"""

from dataclasses import replace

from poem_jax.experiments.tiny_continued import config as by_cpu

_TIMES = 8

config = replace(
    by_cpu,
    name="tiny_accelerator",
    data=replace(
        by_cpu.data,
        batches=tuple(replace(b, batch_size=_TIMES * b.batch_size) for b in by_cpu.data.batches),
        prefetch=6,
        workers=3,
    ),
    optimizer=replace(by_cpu.optimizer, learning_rate=3e-4),
    train=replace(
        by_cpu.train,
        steps=by_cpu.train.steps // _TIMES,
        out="runs/tiny_accelerator",
        log_every=10,
        checkpoint_every=200,
        keep_checkpoints=1,
        validate_every=500,
        host_devices=1,
    ),
)
