"""`v2_base_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v2_base_synthetic import config as config
