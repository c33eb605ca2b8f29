"""`v1_paper`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v1_paper import config as config
from poem_jax.experiments.v1_paper import configs as configs
