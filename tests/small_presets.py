"""Every preset as thin as it gets, as `--smoke` tries it, and the joint decoder that goes with that."""

from dataclasses import replace

from poem_jax.experiments.parts.small_models import DISTANCE_M as DISTANCE_M
from poem_jax.experiments.parts.small_models import NUM_VIEWS as NUM_VIEWS
from poem_jax.experiments.parts.small_models import small as small
from poem_jax.models.config import Config, JointDecoderConfig

_JOINT_DECODER = JointDecoderConfig(num_layers=1, width=8, num_heads=2, num_blocks=1, picked_features=2)


def with_joint_decoder(config: Config) -> Config:
    return replace(config, joint_decoder=_JOINT_DECODER)
