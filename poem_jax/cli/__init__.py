"""`poem`, the command line: one file a command, and `run.py`, which reads the arguments and runs one of them.

Arguments are parsed before JAX is imported, so that help is quick and devices can still be chosen. `run.py`
and what it needs are imported by `start` alone, so that Ctrl-C ends the program in words meanwhile, too.
"""

import sys
from collections.abc import Sequence

from poem_jax.cli.signals import USAGE_ERROR, exit_code

__all__ = ["USAGE_ERROR", "main", "start"]


def start(arguments: Sequence[str] | None = None) -> int:
    """Run `main` as a program of its own: with the allocator that suits it, and undisturbed by `| head`."""
    try:
        from poem_jax.cli.run import start as run

        return run(arguments)
    except KeyboardInterrupt as request:
        print("poem: stopped by SIGINT", file=sys.stderr)
        return exit_code(request)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; see `run.main`."""
    from poem_jax.cli.run import main as run

    return run(arguments)
