"""`v2_nano_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v2_nano_synthetic import config as config
