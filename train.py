"""Train an experiment: `python train.py CONFIG [overrides]`.

CONFIG is a Python file that defines `config = TrainConfig(...)`, as those in `configs/`. Overrides are typed:
`--train.max-minutes 30 --optimizer.learning-rate 3e-4`; `python train.py CONFIG --help` lists them. The same
command goes on from the newest checkpoint of the run directory. `--export DIR` writes the averaged weights of
the newest checkpoint as a model, and trains nothing.
"""

import argparse
import logging
import os
import sys

import jax

from poem_jax.io.compilation_cache import use_compilation_cache
from poem_jax.training.config import TrainConfig, git_commit, load_experiment, override


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="train.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        add_help=False,
        allow_abbrev=False,
    )
    parser.add_argument("config_file", metavar="CONFIG")
    parser.add_argument("--export", metavar="DIR")
    if not arguments or arguments[0] in ("-h", "--help"):
        parser.print_help()
        return 0
    options, overrides = parser.parse_known_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    for chatty in ("absl", "jax"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    try:
        config = override(load_experiment(options.config_file), overrides)
        prepare(config)
        return run(config, options.export)
    except (ValueError, FileNotFoundError, FloatingPointError) as error:
        print(f"train.py: {error}", file=sys.stderr)
        return 1


def prepare(config: TrainConfig) -> None:
    """Choose devices and the compilation cache before JAX starts."""
    if config.train.require_clean_commit and git_commit().endswith(("+changes", "unknown")):
        raise ValueError("`train.require_clean_commit` is on, but the working tree has uncommitted changes")
    devices = config.train.host_devices
    if devices > 1 and "device_count" not in os.environ.get("XLA_FLAGS", ""):
        jax.config.update("jax_num_cpu_devices", devices)
    # Host devices that wait for each other hold threads of the shared pool; one thread a core would starve.
    os.environ.setdefault("PJRT_NPROC", str(max(4 * devices, os.cpu_count() or 1)))
    use_compilation_cache()


def run(config: TrainConfig, export_to: str | None) -> int:
    """Train, or export."""
    from poem_jax.training.checkpoints import export_run
    from poem_jax.training.loop import train

    if export_to is not None:
        step = export_run(config, export_to)
        print(f"wrote the weights of step {step} to {export_to}")
        return 0
    state = train(config)
    print(
        f"step {int(state.step)} of {config.train.steps}; checkpoints and metrics are in {config.train.out}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
