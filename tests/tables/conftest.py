"""Miniatures of all test sets where the tables look for them, and models too small to be good."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from poem_jax.experiments.parts.small_models import small
from poem_jax.miniatures import captures
from poem_jax.miniatures.mano_stand_in import write_mano
from poem_jax.miniatures.names import WRITERS
from poem_jax.models.apply import init
from poem_jax.models.config import ModelConfig
from poem_jax.models.poem_v1_config import PoemV1Config, TokenDecoderConfig
from poem_jax.models.presets import preset
from poem_jax.tables.places import Places
from poem_jax.typing import Params
from poem_jax.weights.store import save
from tests.micro import MICRO


@pytest.fixture(scope="session")
def places(tmp_path_factory) -> Places:
    """OakInk and HO-3D v3's evaluation set, one frame each, and POEM v2's checkpoints of one size."""
    places = Places(*(tmp_path_factory.mktemp(name) for name in ("data", "checkpoints")))
    WRITERS["tars-oakink"](places.tars, samples=1)
    WRITERS["ho3d-v3"](places.raw / "HO3D", frames=1)
    write_mano(places.mano)
    params = shaken(init(MICRO, key=jax.random.key(0)))
    for name in ("v2-small", "v2-base", "v2-large"):
        save(places.checkpoints / name, MICRO, params)
    return places


@pytest.fixture(scope="session")
def all_places(places) -> Places:
    """The other test sets as well, and a capture."""
    for name in ("dexycb", "ho3d", "arctic", "interhand"):
        WRITERS[f"tars-{name}"](places.tars, samples=1)
    WRITERS["ho3d-v2"](places.raw / "HO3D", frames=1)
    captures.write(places.capture, frames=2)
    return places


def write_small(places: Places, name: str, of: str) -> Path:
    """Write a thin model of a preset's system as a checkpoint, if it is not there."""
    folder, config = places.checkpoints / name, in_reach(small(preset(of)))
    if not folder.exists():
        save(folder, config, shaken(init(config, key=jax.random.key(1))))
    return folder


def shaken(params: Params) -> Params:
    """Move all weights: offsets begin at zero, where every vertex is the same point."""
    rng = np.random.default_rng(0)
    moved = jax.tree.map(lambda x: x + 0.05 * rng.standard_normal(x.shape, np.float32), params["trainable"])
    return {**params, "trainable": moved}


def in_reach(config: ModelConfig) -> ModelConfig:
    """Let the grids before POEM v1's cameras reach the hands of miniatures, 0.5 to 0.9 m away."""
    if not isinstance(config, PoemV1Config):
        return config
    # Tokens have their channels shared out to the depths.
    num_depths = 2 if isinstance(config.decoder, TokenDecoderConfig) else 16
    frustum = replace(config.basis.frustum, num_depths=num_depths, start=0.3, end=1.1)
    return replace(config, basis=replace(config.basis, frustum=frustum))
