"""`v2_medium_release_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v2_medium_release_synthetic import config as config
