"""`python eval.py EXPERIMENT ...` is `poem eval EXPERIMENT ...`."""

import sys

from poem_jax.cli import start

if __name__ == "__main__":
    sys.exit(start(["eval", *sys.argv[1:]]))
