"""`tiny_second_stage`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.tiny_second_stage import config as config
