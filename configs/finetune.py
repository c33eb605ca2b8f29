"""`finetune`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.finetune import config as config
