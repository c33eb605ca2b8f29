"""`synthetic_table`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.synthetic_table import config as config
from poem_jax.experiments.synthetic_table import configs as configs
