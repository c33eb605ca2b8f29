"""From arguments to an exit code: one command is read, run, and ends in one line whatever happens."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import tyro

from poem_jax.cli.calibration import Calibration
from poem_jax.cli.demo import Demo
from poem_jax.cli.detect import Detect
from poem_jax.cli.evaluate import Eval
from poem_jax.cli.export_torch import ExportTorch
from poem_jax.cli.fit import Fit
from poem_jax.cli.import_torch import ImportTorch
from poem_jax.cli.inspect import Inspect
from poem_jax.cli.live import Live
from poem_jax.cli.messages import DISK_FULL, set_up_logging
from poem_jax.cli.pack import Pack
from poem_jax.cli.reconstruct import Reconstruct
from poem_jax.cli.retarget import Retarget
from poem_jax.cli.signals import USAGE_ERROR, UntilReaderLeaves, exit_code, stop_on_signals
from poem_jax.cli.train import Train

Command = (
    Demo
    | Reconstruct
    | Fit
    | Detect
    | Live
    | Calibration
    | Retarget
    | Inspect
    | Train
    | Eval
    | ImportTorch
    | ExportTorch
    | Pack
)
_Commands = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Detect, tyro.conf.subcommand("detect")]
    | Annotated[Live, tyro.conf.subcommand("live")]
    | Annotated[Retarget, tyro.conf.subcommand("retarget")]
    | Annotated[Calibration, tyro.conf.subcommand("calibration")]
    | Annotated[Inspect, tyro.conf.subcommand("inspect")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[ImportTorch, tyro.conf.subcommand("import-torch")]
    | Annotated[ExportTorch, tyro.conf.subcommand("export-torch")]
    | Annotated[Pack, tyro.conf.subcommand("pack")]
)


def start(arguments: Sequence[str] | None = None) -> int:
    """Run `main` as a program of its own: with the allocator that suits it, and undisturbed by `| head`."""
    from poem_jax.io.allocator import restart_with_settings

    restart_with_settings()
    sys.stdout, sys.stderr = UntilReaderLeaves(sys.stdout), UntilReaderLeaves(sys.stderr)
    return main(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0; or 1, where `poem calibration check` found something; or 2, with one line on standard error, for wrong
    input; or 128 + the number of the signal that came.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if empty := _empty_option(arguments):
        print(f"poem: error: {empty}: is a shell variable unset?", file=sys.stderr)
        return USAGE_ERROR
    command = parse(arguments)
    set_up_logging()
    try:
        with stop_on_signals():
            return _run(command)
    except KeyboardInterrupt as request:
        print(f"poem: stopped by {request or 'SIGINT'}", file=sys.stderr)
        return exit_code(request)
    except (ValueError, OSError, ModuleNotFoundError, FloatingPointError) as error:
        if command.debug:
            raise
        print(f"poem: error: {_told(error)}", file=sys.stderr)
        return USAGE_ERROR


def _told(error: Exception) -> str:
    """Return an error's text, in our words where the disk is full."""
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        where = f" at {error.filename}" if error.filename else ""
        return f"the disk is full{where}: make room, or give another folder"
    return str(error)


def _run(command: Command) -> int:
    from poem_jax.io.compilation_cache import use_compilation_cache

    use_compilation_cache()
    return command.run() or 0


def parse(arguments: Sequence[str]) -> Command:
    """Read the arguments; help and wrong ones end the program.

    What follows the experiment of `train` and is none of its own options is left to the experiment's fields.
    """
    if len(arguments) < 2 or arguments[0] != "train" or arguments[1].startswith("-"):
        return _cli(arguments)
    own = [argument for argument in arguments if argument not in ("-h", "--help")]
    command, fields = _cli(own, return_unknown_args=True)
    asked_for_help = ["--help"] if len(own) < len(arguments) else []
    return replace(command, overrides=(*fields, *asked_for_help))


def _empty_option(arguments: Sequence[str]) -> str | None:
    """Say which argument is empty, as a shell's unset variable is: it would mean the folder `.`."""
    for before, argument in zip(("", *arguments), arguments, strict=False):
        name, given, value = argument.partition("=")
        if not argument:
            return f"an empty argument after {before!r}" if before else "an empty argument"
        if name.startswith("--") and given and not value:
            return f"nothing after '{argument}'"
    return None


def _cli(arguments: Sequence[str], **options: Any) -> Any:
    return tyro.cli(
        _Commands,  # pyright: ignore[reportArgumentType]
        prog="poem",
        description="Metric 3D hands from any number of calibrated cameras.",
        args=arguments,
        **options,
    )
