"""`python train.py EXPERIMENT ...` is `poem train EXPERIMENT ...`."""

import sys

from poem_jax.cli import start

if __name__ == "__main__":
    sys.exit(start(["train", *sys.argv[1:]]))
