"""`poem`, the command line: one file a command, and `run.py`, which reads the arguments and runs one of them.

Arguments are parsed before JAX is imported, so that help is quick and devices can still be chosen.
"""

from poem_jax.cli.run import USAGE_ERROR, main, start

__all__ = ["USAGE_ERROR", "main", "start"]
