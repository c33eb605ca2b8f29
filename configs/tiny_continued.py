"""`tiny_continued`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.tiny_continued import config as config
