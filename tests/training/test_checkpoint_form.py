"""The form of checkpoints: a run that began with an earlier version goes on with this one.

A checkpoint is restored by the names, shapes and kinds of its arrays. Those of November 2026 are stored
beside this file; whoever changes one must bring files of that form into today's in `Checkpoints.restore`,
and test it here with the stored list.
"""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from poem_jax.losses import SYNTHETIC
from poem_jax.models.config import FeatureConfig, FirstQueries, HRNetConfig, JointDecoderConfig, RootConfig
from poem_jax.models.network import describe
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.training.config import DataConfig, OptimizerConfig, TrainConfig
from poem_jax.training.state import create_state
from poem_jax.weights.store import flatten
from tests import micro

FILE = Path(__file__).with_name("checkpoint_form.json")
PARTS = {
    "resnet": replace(
        micro.MICRO,
        root=RootConfig(num_joints=21, stride=4),
        features=FeatureConfig(stride=4, heat_maps=True),
        joint_decoder=JointDecoderConfig(num_layers=1, num_blocks=1),
        decoder=replace(micro.MICRO.decoder, first_queries=FirstQueries.JOINTS, embed_coordinates=True),
    ),
    "hrnet": replace(
        micro.MICRO, backbone=HRNetConfig(4, stem_channels=4, stem_blocks=2, modules=(1, 1, 1), blocks=1)
    ),
}


def form() -> dict[str, str]:
    """List the arrays of states with averaged weights, for every part of a model that is trained here."""
    listed = {}
    for name, model in PARTS.items():
        config = TrainConfig(
            name=name,
            model=model,
            loss=SYNTHETIC,
            data=DataConfig(synthetic=SyntheticConfig(image_hw=(32, 32))),
            optimizer=OptimizerConfig(ema_decay=0.9),
        )
        shapes = describe(model)
        state = jax.eval_shape(lambda params, config=config: create_state(params, config), shapes)
        for leaf, value in flatten(state).items():
            listed[f"{name}/{leaf}"] = f"{value.dtype} {list(np.shape(value))}"
    return listed


def test_it_is_that_of_the_first_runs() -> None:
    stored = json.loads(FILE.read_text(encoding="utf-8"))
    assert form() == stored
