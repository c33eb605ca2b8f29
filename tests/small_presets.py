"""Every preset as thin as it gets, as `--smoke` tries it."""

from poem_jax.experiments.parts.small_models import DISTANCE_M as DISTANCE_M
from poem_jax.experiments.parts.small_models import NUM_VIEWS as NUM_VIEWS
from poem_jax.experiments.parts.small_models import small as small
from poem_jax.experiments.parts.small_models import with_joint_decoder as with_joint_decoder
