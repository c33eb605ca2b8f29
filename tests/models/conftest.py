"""A model small enough for every test, with weights that make all of its parts matter."""

import functools
from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.geometry.cameras import Cameras
from poem_jax.geometry.neighbours import farthest_points
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.hand.model import template_queries
from poem_jax.hand.template import default_hand
from poem_jax.models.config import (
    AggregationConfig,
    Config,
    DecoderOutput,
    Design,
    FirstQueries,
    HRNetConfig,
    JointDecoderConfig,
    RootConfig,
    Similarity,
)
from poem_jax.models.network import describe
from poem_jax.models.point_features import basis_points
from tests import micro

_MICRO = replace(
    micro.MICRO,
    aggregation=AggregationConfig(similarity=Similarity.MEAN),
    decoder=replace(micro.MICRO.decoder, num_layers=2),
)


def drawn(config: Config, seed: int = 0) -> dict:
    """Return random weights, so that zero initial ones hide nothing, without compiling anything."""
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        name = path[-1].key
        if name in ("scale", "variance"):
            return rng.uniform(0.5, 1.5, leaf.shape).astype(np.float32)
        fan_in = np.prod(leaf.shape[-4:-1]) if name == "kernel" else 4
        return (rng.normal(size=leaf.shape) / np.sqrt(fan_in)).astype(np.float32)

    shapes = describe(config)
    weights = jax.tree_util.tree_map_with_path(draw, {k: shapes[k] for k in ("trainable", "statistics")})
    return {**weights, "constants": constants(config)}


@functools.cache
def constants(config: Config) -> dict:
    hand = default_hand()
    template = template_queries(hand, config.decoder.query_order)
    made = {
        "basis_points": basis_points(config.basis),
        "template_queries": template,
        "hand": hand._asdict(),
    }
    if config.decoder.layer is Design.RELEASE:
        index = farthest_points(template, config.decoder.num_neighbours)
        made["anchors"] = {"index": index, "positions": template[index] / np.float32(config.basis.radius)}
    return made


@pytest.fixture(scope="session")
def micro_config() -> Config:
    return _MICRO


@pytest.fixture(scope="session")
def joints_config() -> Config:
    """All 21 joints, which move and then pose the template."""
    decoder = replace(_MICRO.decoder, first_queries=FirstQueries.JOINTS, embed_coordinates=True)
    moving = JointDecoderConfig(num_layers=1, width=8, num_heads=2, num_blocks=1, picked_features=2)
    return replace(_MICRO, root=RootConfig(num_joints=21), joint_decoder=moving, decoder=decoder)


@pytest.fixture(scope="session")
def parametric_config() -> Config:
    return replace(_MICRO, decoder=replace(_MICRO.decoder, output=DecoderOutput.HAND_PARAMETERS))


@pytest.fixture(scope="session")
def hrnet_config() -> Config:
    """The paper's trunk with every stage and kind of exchange, as thin as it gets; one decoder layer."""
    trunk = HRNetConfig(4, stem_channels=4, stem_blocks=2, modules=(1, 1, 1), blocks=1)
    return replace(_MICRO, backbone=trunk, decoder=replace(_MICRO.decoder, num_layers=1))


@pytest.fixture(scope="session")
def make_params():
    """Return `params` of a config, made once per session."""
    made: dict = {}

    def make(config: Config) -> dict:
        if config not in made:
            made[config] = drawn(config)
        return made[config]

    return make


@pytest.fixture(scope="session")
def make_scene():
    """Return random images and cameras that look at a point near the world's origin from all sides."""

    def make(batch: int, views: int, seed: int = 0, hw: tuple[int, int] = (32, 32)):
        rng = np.random.default_rng(seed)
        R = rotation_from_axis_angle(rng.normal(size=(batch, views, 3)))
        T = rigid(R, np.array([0.0, 0.0, 0.6]) + 0.02 * rng.normal(size=(batch, views, 3)))
        f = 0.6 / 0.2 * hw[1]
        K = np.tile(np.array([[f, 0, hw[1] / 2], [0, f, hw[0] / 2], [0, 0, 1]]), (batch, views, 1, 1))
        images = rng.integers(0, 256, (batch, views, *hw, 3), dtype=np.uint8)
        mask = np.ones((batch, views), bool)
        return images, Cameras(K.astype(np.float32), T.astype(np.float32), mask)

    return make
