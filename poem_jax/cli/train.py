"""`poem train`."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from poem_jax.cli.messages import say, tells_what_is_left
from poem_jax.cli.options import Experiment, Flag, OptionalFolder

if TYPE_CHECKING:
    from poem_jax.training.config import TrainConfig


@dataclass(frozen=True)
class Train:
    """Train an experiment; the same command goes on from the newest checkpoint.

    Every field of the experiment can be given another value, as in --train.max-minutes 30
    --optimizer.learning-rate 3e-4; `poem train EXPERIMENT --help` lists them.
    """

    experiment: Experiment
    """An experiment of the package, such as tiny_synthetic, or a Python file that defines `config`."""
    export: OptionalFolder = None
    """Write the averaged weights of the newest checkpoint there as a model, and train nothing."""
    debug: Flag = False
    """Show the full traceback of an error."""
    overrides: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()

    def run(self) -> None:
        """Train, or export, and print how far it is and where the results are."""
        from poem_jax.experiments import open_experiment

        config = override(open_experiment(self.experiment), self.overrides)
        choose_devices(config)
        if self.export is not None:
            self._export(config)
            return
        from poem_jax.training.loop import train

        out, steps = config.train.out, config.train.steps
        with tells_what_is_left(Path(out)):
            state = train(config)
        print(f"step {int(state.step)} of {steps}; checkpoints and metrics are in {out}")

    def _export(self, config: "TrainConfig") -> None:
        from poem_jax.io.writable import check_folder_is_writable
        from poem_jax.training.checkpoints import export_run

        assert self.export is not None
        check_folder_is_writable(self.export, "--export")
        say(f"reading the newest checkpoint in {config.train.out}")
        step = export_run(config, self.export)
        print(f"wrote the weights of step {step} to {self.export}")


def override(config: "TrainConfig", arguments: Sequence[str]) -> "TrainConfig":
    """Apply options such as `--train.max-minutes 30`; unknown names end the program with exit code 2."""
    from poem_jax.training.config import TrainConfig

    return tyro.cli(
        TrainConfig,
        default=config,
        args=list(arguments),
        prog="poem train EXPERIMENT",
        config=(tyro.conf.AvoidSubcommands, tyro.conf.EnumChoicesFromValues),
    )


def choose_devices(config: "TrainConfig") -> None:
    """Make as many devices of the CPU as the experiment asks for; call it before JAX starts."""
    import jax

    devices = config.train.host_devices
    if devices > 1 and "device_count" not in os.environ.get("XLA_FLAGS", ""):
        jax.config.update("jax_num_cpu_devices", devices)
    # Host devices that wait for each other hold threads of the shared pool; one thread a core would starve.
    os.environ.setdefault("PJRT_NPROC", str(max(4 * devices, os.cpu_count() or 1)))
