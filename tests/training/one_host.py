"""One host of a short run of the micro model, as a process: `python -m tests.training.one_host '{...}'`."""

import json
import os
import sys
from pathlib import Path

from poem_jax.losses import SYNTHETIC
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.training.config import BatchShape, DataConfig, OptimizerConfig, RunConfig, TrainConfig
from tests.training.conftest import HW, MICRO

MANY = 100_000
"""Steps that nobody waits for."""


def config_of(out: Path, *, steps: int) -> TrainConfig:
    """A run of so many steps of its first stage, which compiles in less time, with batches of four and a
    checkpoint every second step."""
    return TrainConfig(
        name="hosts",
        model=MICRO,
        loss=SYNTHETIC,
        data=DataConfig(
            synthetic=SyntheticConfig(image_hw=HW, num_views=2, supersample=1, num_backgrounds=2),
            batches=(BatchShape(num_views=2, batch_size=4, min_views=1),),
        ),
        first_stage_steps=MANY,
        optimizer=OptimizerConfig(learning_rate=1e-3, ema_decay=0.9, decay_steps=10),
        train=RunConfig(
            steps=steps, out=str(out), log_every=1, checkpoint_every=2, keep_checkpoints=1000, progress=False
        ),
    )


def _main(out: str, steps: int, coordinator: str, count: int, index: int) -> None:
    os.environ["XLA_FLAGS"] = os.environ["XLA_FLAGS"].replace("device_count=2", "device_count=1")
    from poem_jax.cli.messages import set_up_logging
    from poem_jax.cli.signals import exit_code
    from poem_jax.io.stopping import Stopped
    from poem_jax.training.hosts import start_hosts
    from poem_jax.training.loop import train

    set_up_logging()
    start_hosts(coordinator, count, index)
    try:
        train(config_of(Path(out), steps=steps))
    except Stopped as request:
        sys.exit(exit_code(request))
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    _main(**json.loads(sys.argv[1]))
