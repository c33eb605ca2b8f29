"""`tiny_synthetic`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.tiny_synthetic import config as config
