"""Vectors of query points that are alike where these are neighbours: which are set, and as what."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.experiments.synthetic_table import configs
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.models.apply import init
from poem_jax.models.config import Design
from poem_jax.models.layers import PerQuery
from poem_jax.models.network import weights_of_kind
from poem_jax.training.checkpoints import Checkpoints
from poem_jax.training.initial_state import initial_state
from poem_jax.training.parallel import data_mesh
from poem_jax.training.query_start import with_smooth_queries
from poem_jax.weights.store import flatten
from tests.micro import MICRO

TABLES = {
    "v2": {"decoder.embeddings"},
    "v2-apart": {"decoder.embeddings"},
    "v2-row-major": {"decoder.embeddings"},
    "v1": {"second.embedding.table"},
    "v1-1stage": {"second.embedding.table"},
    "v1-wo-proj": {"second.embedding.table"},
    "v1-wo-pt": {"second.embedding.table"},
    "v1-gv-emb": {"second.embedding.table"},
    "v1-g-emb": set(),
    "pe-meshtr": {"queries.embeddings"},
    "ftl-meshtr": {"queries.embeddings"},
    "mvp": {"queries.table"},
}


@pytest.mark.parametrize("name", configs)
def test_systems_of_the_table_begin_so_where_they_have_such_vectors(name):
    config = configs[name]
    assert {".".join(path) for path in weights_of_kind(config.model, PerQuery)} == TABLES[name]
    assert config.train.smooth_queries == (bool(TABLES[name]) and name != "v2-apart")


JOINTS_FIRST = replace(
    MICRO,
    basis=replace(MICRO.basis, num_points=799),
    decoder=replace(MICRO.decoder, layer=Design.RELEASE),
)
SYSTEMS = {
    "micro": (MICRO, "decoder.embeddings"),
    "joints first": (JOINTS_FIRST, "decoder.embeddings"),
    **{name: (configs[name].model, *TABLES[name]) for name in ("v1", "v1-wo-pt", "pe-meshtr", "mvp")},
}


@pytest.mark.parametrize(("config", "table"), SYSTEMS.values(), ids=SYSTEMS.keys())
def test_neighbours_on_the_template_begin_alike(config, table):
    fresh = init(config, key=jax.random.key(0))
    before, after = flatten(fresh), flatten(with_smooth_queries(fresh, config, seed=0))
    changed = {name for name in before if not np.array_equal(before[name], after[name])}
    assert changed == {f"trainable.{table}"}
    vectors = np.asarray(after[f"trainable.{table}"], np.float64)
    hand = hand_mesh(default_hand(), np.zeros((16, 3), np.float32), np.zeros(10, np.float32))
    points = [hand.joints] if len(vectors) == 21 else [hand.vertices, hand.joints]
    places = np.concatenate(points[::-1] if config is JOINTS_FIRST else points)
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    unlike = np.linalg.norm(vectors[:, None] - vectors, axis=-1) / np.sqrt(2 * vectors.shape[-1])
    near, far = (apart > 0) & (apart < 0.02), apart > 0.1
    assert unlike[near].mean() < 0.3 < 0.6 < unlike[far].mean()
    assert unlike[near].max() < 0.5
    np.testing.assert_allclose(np.std(vectors), 1.0, atol=0.3)


def test_the_seed_decides_them():
    fresh = init(MICRO, key=jax.random.key(0))
    first, again, other = (
        with_smooth_queries(fresh, MICRO, seed)["trainable"]["decoder"]["embeddings"] for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(np.asarray(first) - np.asarray(other)).mean() > 0.3


def test_a_system_without_such_vectors_is_refused():
    config = configs["v1-g-emb"].model
    with pytest.raises(ValueError, match=r"smooth_queries.*PoemV1Config has none"):
        with_smooth_queries(init(config, key=jax.random.key(0)), config, seed=0)


@pytest.mark.parametrize("smooth", [True, False])
def test_a_fresh_run_begins_as_it_is_told(micro_config, smooth):
    config = replace(micro_config, train=replace(micro_config.train, smooth_queries=smooth))
    with Checkpoints(config.train.out, config) as checkpoints:
        state = initial_state(config, checkpoints, data_mesh(jax.devices()[:1]))
    fresh = init(config.model, key=jax.random.key(config.train.seed))
    expected = with_smooth_queries(fresh, config.model, config.train.seed) if smooth else fresh
    jax.tree.map(np.testing.assert_array_equal, state.params["trainable"], expected["trainable"])


def test_weights_to_start_from_are_not_overwritten(micro_config):
    with pytest.raises(ValueError, match=r"turn `train\.smooth_queries` off"):
        replace(micro_config, train=replace(micro_config.train, init_from="somewhere", smooth_queries=True))
