"""`v1_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v1_synthetic import config as config
