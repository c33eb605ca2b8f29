"""`v2_param_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v2_param_synthetic import config as config
