"""The released MvP, on procedural weights, against what the authors' code stored: for 4 cameras on inputs a,
for 8 on b; every stored array, the losses and the metrics.

There are no searches in MvP, so that no ties can turn: float32 meets float32 at every point.
"""

import functools
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.evaluation.metrics import evaluate
from poem_jax.hand.topology import split_queries
from poem_jax.losses import MVP, multi_view_losses
from poem_jax.models import mvp
from poem_jax.models.config import Design, FrozenNorms, ResNetConfig
from poem_jax.models.layers import NormMode
from poem_jax.models.mvp import Mvp
from poem_jax.models.mvp_config import MvpConfig
from poem_jax.models.network import Draw, reconstruct
from poem_jax.models.world_frame import enter_working_frame
from poem_jax.weights.v1_mvp_keys import constant_rows, hand_prefixes, unused_shapes, used_rows
from tests.weights.listening import Ears, listening
from tests.weights.procedural import in_float32
from tests.weights.v1_procedural import (
    REFERENCE_V1,
    batch_of,
    golden,
    hand,
    load_rows,
    manifest,
    needs_reference_v1,
    state_dict,
)

pytestmark = needs_reference_v1

VIEWS = {"mvp4": 4, "mvp8": 8}
CASES = {"mvp4": "a", "mvp8": "b"}
METRES = 5e-6
LAYERS = range(6)


def config_of(model: str) -> MvpConfig:
    trunk = ResNetConfig.resnet34(FrozenNorms.STAGE_STARTS)
    return MvpConfig(design=Design.RELEASE, num_views=VIEWS[model], backbone=trunk)


def released(model: str) -> Mvp:
    config = config_of(model)
    made, state = Mvp(config, hand(), rngs=nnx.Rngs(0)), state_dict(model)
    load_rows(made, list(used_rows(config)), state)
    (components,) = constant_rows(config)
    assert components.path == "constants.pose_components"
    made.pose_components[...] = jnp.asarray(state[components.source])
    return made


# Names.


@pytest.mark.parametrize("model", CASES)
def test_the_tables_are_the_whole_state_dict(model: str) -> None:
    config, entries = config_of(model), manifest(model)
    used = {row.source for row in (*used_rows(config), *constant_rows(config))}
    prefixes = tuple(hand_prefixes(config))
    buffers = {e.name for e in entries if e.name.startswith(prefixes)} - used
    unused = dict(unused_shapes(config))
    assert used | buffers | unused.keys() == {e.name for e in entries}
    assert not used & unused.keys()
    shapes = {e.name: e.shape for e in entries}
    assert unused == {name: shapes[name] for name in unused}


@pytest.mark.parametrize("model", CASES)
def test_what_the_release_uses_is_used(model: str) -> None:
    """And what it does not is not: but for buffers of the hand, of which ours keeps what it needs."""
    used = {row.source for row in (*used_rows(config_of(model)), *constant_rows(config_of(model)))}
    prefixes = tuple(hand_prefixes(config_of(model)))
    entries = [e for e in manifest(model) if not e.name.startswith(prefixes)]
    assert {e.name for e in entries if e.used} == {name for name in used if not name.startswith(prefixes)}


@pytest.mark.parametrize("model", CASES)
def test_frozen_norms_are_no_weights(model: str) -> None:
    frozen = {e.name for e in manifest(model) if e.kind == "frozen_bn_affine"}
    trained = {row.source for row in used_rows(config_of(model)) if row.path.startswith("trainable.")}
    assert {e.name for e in manifest(model) if e.kind == "param" and e.used} == trained
    assert frozen
    assert frozen.isdisjoint(trained)


# The run.


class Run(NamedTuple):
    """A released model on its inputs."""

    prediction: Prediction
    heard: dict[str, list]
    """What parts of it were given and gave, call by call."""


HEARD: Ears = {
    "queries": (mvp.ReleaseQueries, "__call__", lambda args, out: (args[1], *out)),
    "scene": (mvp, "view_scene", lambda args, out: (out.levels, out.rays)),
    "self_attention": (mvp.MultiHeadAttention, "__call__", lambda args, out: out),
    "values": (mvp.ReleaseProjectiveAttention, "_values", lambda args, out: out),
    "read": (
        mvp.ReleaseProjectiveAttention,
        "__call__",
        lambda args, out: (args[1], args[2].uv_share, out),
    ),
    "layers": (mvp.MvpLayer, "__call__", lambda args, out: out),
}
"""What is kept of every call of a function or method."""


@functools.cache
def run(model: str) -> Run:
    made, batch = released(model), batch_of(CASES[model])
    frame = enter_working_frame(batch.views, batch.cameras, None, np.float32)
    graph, state = nnx.split(made)

    @jax.jit
    def predict(state: Any, views: Any, frame: Any) -> tuple[Prediction, dict]:
        model = nnx.merge(graph, state)
        with listening(HEARD) as heard:
            prediction = reconstruct(model, views, frame, NormMode(), Draw())
        heard["global"] = [model.queries.mix(heard["queries"][0][0])]
        return prediction, dict(heard)

    return Run(*jax.tree.map(np.asarray, predict(state, batch.views, frame)))


def by_layer(theirs: np.ndarray) -> np.ndarray:
    """Bring the release's (layer, batch, ...) into our order."""
    return np.moveaxis(theirs, 0, 1)


def close(ours: Any, theirs: np.ndarray, atol: float) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol)


def images(x: np.ndarray) -> np.ndarray:
    """Join batch and view."""
    return x.reshape(-1, *x.shape[2:])


# Points.


def check_points(model: str, key: str) -> None:
    """All layers."""
    close(run(model).prediction.layers_world, by_layer(golden_of(model)[key]), METRES)


def check_hand(model: str, key: str) -> None:
    numbers = np.stack([layer[2] for layer in run(model).heard["layers"]])
    close(numbers, golden_of(model)[key], 2e-5)


# Intermediates.


def check_joints(model: str, key: str) -> None:
    close(np.stack([layer[1] for layer in run(model).heard["layers"]]), golden_of(model)[key], 2e-6)


def check_global_in(model: str, key: str) -> None:
    close(run(model).heard["queries"][0][0], golden_of(model)[key], 1e-5)


def check_global(model: str, key: str) -> None:
    close(run(model).heard["global"][0], golden_of(model)[key], 1e-5)


def check_start(model: str, key: str) -> None:
    close(run(model).heard["queries"][0][3], golden_of(model)[key], 2e-6)


def check_level(model: str, key: str) -> None:
    """Stored of view 1, channels first, thinned to 8 x 8."""
    i = int(key.split("_")[2])
    level = images(run(model).heard["scene"][0][0][i])[1, :: 2**i, :: 2**i]
    close(np.moveaxis(level, -1, 0), golden_of(model)[key], 2e-5)


def check_rays(model: str, key: str) -> None:
    close(images(run(model).heard["scene"][0][1][int(key[-1])]), golden_of(model)[key], 1e-6)


def check_self_attention(model: str, key: str) -> None:
    """Stored (query, batch, channel)."""
    ours = run(model).heard["self_attention"][layer_of(key)]
    close(np.swapaxes(ours, 0, 1), golden_of(model)[key], 1e-5)


def check_rayconv(model: str, key: str) -> None:
    """Stored are the first 256 cells of view 1, level after level."""
    values = run(model).heard["values"][layer_of(key)]
    cells = np.concatenate([images(x)[1].reshape(-1, x.shape[-1]) for x in values])
    close(cells[:256], golden_of(model)[key], 2e-5)


def check_query(model: str, key: str) -> None:
    """Stored once a view."""
    queries = run(model).heard["read"][layer_of(key)][0]
    close(np.repeat(queries, VIEWS[model], 0), golden_of(model)[key], 1e-5)


def check_places(model: str, key: str) -> None:
    close(images(run(model).heard["read"][layer_of(key)][1]), golden_of(model)[key], 2e-6)


def check_read(model: str, key: str) -> None:
    close(images(run(model).heard["read"][layer_of(key)][2]), golden_of(model)[key], 5e-5)


def check_embeddings(model: str, key: str) -> None:
    close(run(model).heard["layers"][layer_of(key)][0], golden_of(model)[key], 2e-5)


def check_layer_hand(model: str, key: str) -> None:
    close(run(model).heard["layers"][layer_of(key)][2], golden_of(model)[key], 2e-5)


def layer_of(key: str) -> int:
    return int(key[len("layer")])


# Losses.

TERMS = {
    "3d_joints": "joints",
    "3d_joints_from_mesh": "regressed_joints",
    "3d_verts": "vertices",
    "2d_joints": "reprojection",
    "2d_verts": "vertex_reprojection",
}
"""Stored names of the last layer's terms, and those of `multi_view_losses`."""


@functools.cache
def losses(model: str) -> dict[str, float]:
    """The training loss of our test-mode outputs, under the stored names."""
    prediction, batch, config = run(model).prediction, in_float32(batch_of(CASES[model])), config_of(model)
    evaluate_loss = jax.jit(
        functools.partial(
            multi_view_losses, image_hw=config.image_hw, recipe=MVP, query_order=config.query_order
        )
    )

    def of_layer(i: int) -> float:
        vertices, joints = split_queries(prediction.layers_world[:, i], config.query_order)
        alone = prediction.layers_world[:, i : i + 1]
        shown = prediction._replace(layers_world=alone, vertices_world=vertices, joints_world=joints)
        return float(evaluate_loss(shown, batch, hand=hand())[0])

    loss, terms = evaluate_loss(prediction, batch, hand=hand())
    named = {f"loss/loss_{theirs}": float(terms[ours]) for theirs, ours in TERMS.items()}
    named |= {f"loss/dec{i}_loss_recon": of_layer(i) for i in LAYERS}
    return named | {"loss/loss": float(loss), "loss/loss_recon": named["loss/dec5_loss_recon"]}


def check_loss(model: str, key: str) -> None:
    np.testing.assert_allclose(losses(model)[key], golden_of(model)[key], rtol=1e-4)


def golden_of(model: str) -> dict[str, np.ndarray]:
    return golden(f"{model}_{CASES[model]}")


OUTPUTS = {
    "all_coords_preds": check_points,
    "mano_pose_shape": check_hand,
    **{f"loss/loss_{name}": check_loss for name in (*TERMS, "recon")},
    **{f"loss/dec{i}_loss_recon": check_loss for i in LAYERS},
    "loss/loss": check_loss,
}
STAGES = {
    "reference_feats_in": check_global_in,
    "reference_feats_out": check_global,
    "reference_points_init": check_start,
    **{f"feat_delayer_{i}_view1": check_level for i in range(3)},
    **{f"camera_rays_lvl{i}": check_rays for i in range(3)},
    "layer0/self_attn_out": check_self_attention,
    "layer0/rayconv_out_view1_first256": check_rayconv,
    "layer0/proj_attn_query": check_query,
    **{f"layer{i}/proj_points_normalised": check_places for i in LAYERS},
    **{f"layer{i}/proj_attn_out": check_read for i in LAYERS},
    **{f"layer{i}/out": check_embeddings for i in LAYERS},
    **{f"layer{i}/mano": check_layer_hand for i in LAYERS},
    "joints_normalised": check_joints,
}
COMPARED = {"mvp4": OUTPUTS | STAGES, "mvp8": OUTPUTS}
"""The check of every stored array; only the first model has its stages stored."""


@pytest.mark.parametrize("model", CASES)
def test_every_stored_array_is_compared(model: str) -> None:
    assert set(COMPARED[model]) == set(golden_of(model))


@pytest.mark.parity
@pytest.mark.parametrize(
    ("model", "key", "check"),
    [pytest.param(m, *row, id=f"{m}-{row[0]}") for m, checks in COMPARED.items() for row in checks.items()],
)
def test_outputs_and_stages(model: str, key: str, check: Callable[[str, str], None]) -> None:
    check(model, key)


METRICS = {
    "MPJPE_3D": "mpjpe_mm",
    "MPVPE_3D": "mpvpe_mm",
    "MPJPE_3D_REL": "rr_mpjpe_mm",
    "MPVPE_3D_REL": "rr_mpvpe_mm",
    "PA/mpjpe": "mpjpe_mm",
    "PA/mpvpe": "mpvpe_mm",
    "PA/pa_mpjpe": "pa_mpjpe_mm",
    "PA/pa_mpvpe": "pa_mpvpe_mm",
}
"""The release's own numbers, in metres, and ours."""


@pytest.mark.parity
@pytest.mark.parametrize("model", CASES)
def test_metrics(model: str) -> None:
    stored = json.loads((REFERENCE_V1 / "metrics.json").read_text())[f"{model}_{CASES[model]}"]
    assert set(stored) == set(METRICS)
    found, batch = run(model).prediction, batch_of(CASES[model])
    points = (found.joints_world, batch.joints_world, found.vertices_world, batch.vertices_world)
    ours = evaluate(*points, protocol="poem")
    for theirs, name in METRICS.items():
        np.testing.assert_allclose(ours[name] / 1000, stored[theirs], rtol=1e-4, err_msg=theirs)
