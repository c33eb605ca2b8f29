"""`poem train`."""

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from poem_jax.cli.messages import called_as, say, tells_what_is_left
from poem_jax.cli.options import Experiment, Flag, OptionalFile, OptionalFolder

if TYPE_CHECKING:
    from poem_jax.training.config import TrainConfig


@dataclass(frozen=True)
class Train:
    """Train an experiment; the same command goes on from the newest checkpoint.

    Every field of the experiment can be given another value, as in --train.max-minutes 30
    --optimizer.learning-rate 3e-4; `poem train EXPERIMENT --help` lists them.
    """

    experiment: Experiment
    """An experiment of the package, such as tiny_synthetic, or a Python file that defines `config`; of a file
    with several, NAME:WHICH."""
    init: Annotated[str | None, tyro.conf.arg(metavar="CKPT")] = None
    """Fine-tune the model in this folder, or the one that comes with the package: shipped. The experiment's
    model becomes the folder's."""
    data: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DIR ...")] = ()
    """Train on these in place of the experiment's data sets: captures with labels (poem fit makes them), or
    whatever else `poem inspect` knows."""
    mano: OptionalFile = None
    """MANO_RIGHT.pkl, for --data that need it."""
    export: OptionalFolder = None
    """Write the averaged weights of the newest checkpoint there as a model (with --train.keep-best, of the
    best one), and train nothing."""
    smoke: Flag = False
    """Try the experiment: two steps of a tiny model on stand-ins of its data, in a folder that is removed."""
    hosts: Annotated[Literal["auto"] | None, tyro.conf.arg(metavar="auto")] = None
    """auto: one of several processes that SLURM, Open MPI or a TPU pod has started."""
    coordinator: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """One of several processes: where the first one listens."""
    num_hosts: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """How many processes there are."""
    host_index: Annotated[int | None, tyro.conf.arg(metavar="I")] = None
    """Which one this is, from 0."""
    debug: Flag = False
    """Show the full traceback of an error."""
    overrides: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()

    def run(self) -> None:
        """Train, or export, and print how far it is and where the results are."""
        config = self._config()
        choose_devices(config)
        if self.smoke:
            self._try(config)
            return
        self._join_hosts()
        if self.export is not None:
            self._export(config)
            return
        self._train(config)

    def _config(self) -> "TrainConfig":
        """Open the experiment and apply the options, each upon what the one before made of it."""
        from poem_jax.experiments import open_experiment

        config = open_experiment(self.experiment)
        if self.init is not None or self.data:
            from poem_jax.training.finetune import start_from, train_on

            config = config if self.init is None else start_from(config, self.init)
            config = train_on(config, self.data, mano=self.mano) if self.data else config
        elif self.mano is not None:
            raise ValueError("--mano belongs to --data; an experiment names its own MANO file")
        return override(config, self.overrides)

    def _try(self, config: "TrainConfig") -> None:
        from poem_jax.experiments.parts.smoke import smoke
        from poem_jax.training.loop import train

        if self.export is not None or self._names_hosts():
            raise ValueError("--smoke is one process that keeps nothing: give it neither --export nor hosts")
        with tempfile.TemporaryDirectory(prefix="poem_smoke_") as folder:
            say(f"trying {config.name} in {folder}")
            state = train(smoke(config, Path(folder)))
        print(f"{config.name}: {int(state.step)} steps of a tiny likeness were taken; nothing is kept")

    def _names_hosts(self) -> bool:
        return any(
            option is not None for option in (self.hosts, self.coordinator, self.num_hosts, self.host_index)
        )

    def _join_hosts(self) -> None:
        if not self._names_hosts():
            return
        named = (self.coordinator, self.num_hosts, self.host_index)
        from poem_jax.training.hosts import start_hosts

        if self.hosts is not None and named != (None, None, None):
            raise ValueError(
                "--hosts auto asks the launcher what --coordinator, --num-hosts and --host-index say; give "
                "one or the other"
            )
        start_hosts(*named)

    def _train(self, config: "TrainConfig") -> None:
        from poem_jax.training.finetune import check_captures
        from poem_jax.training.loop import train

        check_captures(config)
        out, steps = config.train.out, config.train.steps
        with tells_what_is_left(Path(out)):
            state = train(config, command=called_as())
        print(f"step {int(state.step)} of {steps}; checkpoints and metrics are in {out}")

    def _export(self, config: "TrainConfig") -> None:
        from poem_jax.io.writable import check_folder_is_writable
        from poem_jax.training.checkpoints import export_run

        assert self.export is not None
        check_folder_is_writable(self.export, "--export")
        say(f"reading a checkpoint in {config.train.out}")
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
