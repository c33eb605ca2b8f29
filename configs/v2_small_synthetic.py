"""`v2_small_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v2_small_synthetic import config as config
