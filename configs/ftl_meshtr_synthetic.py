"""`ftl_meshtr_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.ftl_meshtr_synthetic import config as config
