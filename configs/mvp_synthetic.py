"""`mvp_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.mvp_synthetic import config as config
