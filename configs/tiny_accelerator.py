"""`tiny_accelerator`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.tiny_accelerator import config as config
