"""`v2_medium_six_sets`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.v2_medium_six_sets import config as config
from poem_jax.experiments.v2_medium_six_sets import configs as configs
