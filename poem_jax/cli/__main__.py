"""`python -m poem_jax.cli` is `poem`."""

import sys

from poem_jax.cli import start

sys.exit(start())
