"""`v1_release`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v1_release import config as config
from poem_jax.experiments.v1_release import configs as configs
