"""The released PE-MeshTR and FTL-MeshTR, on procedural weights, against what the authors' code stored.

Points are compared as users have them, in float32; intermediates in float64.

The tables are what the tests run over; `test_every_stored_array_is_compared` sees to it that none is missing
from them.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
import pytest
from flax import nnx

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.hand.model import joints_from_vertices, template_queries
from poem_jax.hand.topology import WRIST, split_queries
from poem_jax.models import mesh_transformers
from poem_jax.models.detr import DetrDecoder
from poem_jax.models.layers import NormMode
from poem_jax.models.mesh_transformer_config import ftl_meshtr_release, pe_meshtr_release
from poem_jax.models.mesh_transformers import CoarsestFeatures, MeshTransformer, PointwiseNetwork
from poem_jax.models.world_frame import WorkingFrame, enter_working_frame
from poem_jax.typing import Array
from poem_jax.weights.v1_mesh_keys import aliases, hand_prefixes, unused_shapes, used_rows
from tests.precision import as_float64
from tests.weights.listening import Ears, Heard, listening
from tests.weights.v1_procedural import (
    amid_garbage,
    batch_of,
    golden,
    hand,
    load_rows,
    manifest,
    needs_reference_v1,
    state_dict,
)

pytestmark = needs_reference_v1

CONFIGS = {"petr": pe_meshtr_release(), "ftl": ftl_meshtr_release()}
"""By the reference's names."""
FARTHEST_M = 5e-6
STAGE = 7e-6
"""Largest difference of an intermediate in float64, over its largest number."""
ALIKE_M = 2e-6
"""Between two programs of ours."""
DIAGONAL_PX = np.hypot(256, 256)


class Case(NamedTuple):
    """A model and the inputs that it was run on."""

    model: str
    inputs: str

    def __str__(self) -> str:
        return f"{self.model}_{self.inputs}"

    @property
    def stored(self) -> dict[str, np.ndarray]:
        return golden(str(self))


CASES = [Case(model, inputs) for model in CONFIGS for inputs in "ab"]


# Names and shapes.


@pytest.mark.parametrize("name", CONFIGS)
def test_the_tables_are_the_manifest(name: str) -> None:
    config, entries = CONFIGS[name], {entry.name: entry for entry in manifest(name)}
    rows, unused = {row.source for row in used_rows(config)}, unused_shapes(config)
    held = {entry.name for entry in entries.values() if entry.hand_field is not None}
    assert rows.isdisjoint(unused)
    assert rows | unused.keys() | held == entries.keys()
    assert {entry: entries[entry].shape for entry in unused} == unused
    assert all(entries[row].used for row in rows)
    assert aliases(config) == {e.name: e.alias_of for e in entries.values() if e.alias_of is not None}
    assert not any(entries[entry].used for entry in unused.keys() - aliases(config).keys())
    assert {entry.rpartition("th_")[0] for entry in held} == hand_prefixes(config).keys()
    for prefix, used in hand_prefixes(config).items():
        assert used == any(entries[entry].used for entry in held if entry.startswith(prefix))


@pytest.mark.parametrize("name", CONFIGS)
def test_the_first_name_of_an_array_has_the_value_of_all(name: str) -> None:
    state = state_dict(name)
    for alias, first in aliases(CONFIGS[name]).items():
        np.testing.assert_array_equal(state[alias], state[first])


# Outputs and stages.

HEARD: Ears = {
    "features": (CoarsestFeatures, "__call__", lambda args, out: (args[1][-1], out)),
    "converted": (mesh_transformers, "_per_image", lambda args, out: (args[1], out)),
    "encoded": (PointwiseNetwork, "__call__", lambda args, out: (args[1], out)),
    "decoded": (DetrDecoder, "__call__", lambda args, out: (*args[1:4], out)),
    "template_queries": (mesh_transformers, "template_queries", lambda args, out: out),
}
"""What is kept of every call of a function or method, in the order of the calls."""


class Run(NamedTuple):
    prediction: Prediction
    heard: Heard


@functools.cache
def released(name: str) -> MeshTransformer:
    model = MeshTransformer(CONFIGS[name], hand(), rngs=nnx.Rngs(0))
    load_rows(model, list(used_rows(CONFIGS[name])), state_dict(name))
    return model


@nnx.jit
def _run(model: MeshTransformer, views: Array, frame: WorkingFrame) -> tuple[Prediction, Heard]:
    with listening(HEARD) as heard:
        prediction = model.find_hands(model.look(views, NormMode()), frame, NormMode())
    return prediction, dict(heard)


def run(name: str, batch: MultiViewBatch) -> Run:
    frame = enter_working_frame(batch.views, batch.cameras, None, np.float32)
    return Run(*jax.tree.map(np.asarray, _run(released(name), batch.views, frame)))


@functools.cache
def ran(case: Case) -> Run:
    return run(case.model, batch_of(case.inputs))


@functools.cache
def heard_in_float64(name: str) -> Heard:
    """Hear case a in float64, where only the stored numbers are rounded, whatever the machine."""
    batch = batch_of("a")
    graph, state = nnx.split(released(name))
    with jax.enable_x64(True):
        frame = enter_working_frame(batch.views, batch.cameras, None, np.float64)
        found = _run(nnx.merge(graph, as_float64(state)), batch.views, frame)
        return jax.tree.map(np.asarray, found)[1]


def check_points(case: Case, key: str) -> None:
    theirs = np.moveaxis(case.stored[key], 0, 1)
    farthest = np.linalg.norm(ran(case).prediction.layers_world - theirs, axis=-1).max()
    assert farthest <= FARTHEST_M


VIEW = 1
"""Of the first sample: what is stored of one view is stored of this."""


def _of_view(maps: np.ndarray, channels: int = 1, cells: int = 1) -> np.ndarray:
    """Cut what is stored of maps (batch, view, h, w, c) or (image, h, w, c): every n-th channel and cell."""
    chosen = maps[0, VIEW] if maps.ndim == 5 else maps[VIEW]
    return np.moveaxis(chosen, -1, 0)[::channels, ::cells, ::cells]


def _tokens_of_view(tokens: np.ndarray) -> np.ndarray:
    """Give the tokens (batch, token, c) of one view their rows and columns back."""
    batch, token, c = tokens.shape
    return _of_view(tokens.reshape(batch, token // 32**2, 32, 32, c), 4)


STAGES: dict[str, Callable[[Heard], np.ndarray]] = {
    "layer2_feat_view1": lambda heard: _of_view(heard["features"][0][0]),
    "input_proj_view1": lambda heard: _of_view(heard["features"][0][1], 4),
    "adapt_pos3d_view1": lambda heard: _of_view(heard["encoded"][-1][1], 4),
    "query_embed": lambda heard: heard["decoded"][0][0][0],
    "tr_x_s0_view1": lambda heard: _tokens_of_view(heard["decoded"][0][1]),
    "tr_pos_s0_view1": lambda heard: _tokens_of_view(heard["decoded"][0][2]),
    "decoder_out_layers_s0": lambda heard: heard["decoded"][0][3][0, :, :96],
}
STAGES_OF_PE: dict[str, Callable[[Heard], np.ndarray]] = {
    "template_mesh": lambda heard: heard["template_queries"][0],
    "position_encoder_in_view1": lambda heard: _of_view(heard["encoded"][0][0], cells=4),
    "position_encoder_out_view1": lambda heard: _of_view(heard["encoded"][0][1], cells=4),
}
STAGES_OF_FTL: dict[str, Callable[[Heard], np.ndarray]] = {
    f"conv{i + 1}_{end}_view1": lambda heard, i=i, n=n: _of_view(heard["converted"][i][n], cells=2)
    for i in range(3)
    for n, end in enumerate(("in", "out"))
}


STAGE_CHECKS = {name: STAGES | more for name, more in (("petr", STAGES_OF_PE), ("ftl", STAGES_OF_FTL))}


def check_stage(case: Case, key: str) -> None:
    ours, theirs = STAGE_CHECKS[case.model][key](heard_in_float64(case.model)), case.stored[key]
    assert ours.dtype == np.float64
    assert ours.shape == theirs.shape
    assert np.abs(ours - theirs).max() <= STAGE * np.abs(theirs).max()


def check_unused_template(case: Case, key: str) -> None:
    """FTL-MeshTR computes the template and reads it nowhere."""
    assert "template_queries" not in heard_in_float64(case.model)
    ours = template_queries(hand(), CONFIGS[case.model].query_order, center_joint=WRIST)
    np.testing.assert_allclose(ours, case.stored[key], atol=1e-7)


@functools.cache
def losses(case: Case) -> dict[str, float]:
    """The release's losses of our points, written anew in NumPy, under the stored names."""
    truth, layers = batch_of(case.inputs), ran(case).prediction.layers_world.astype(np.float64)
    rows = [_losses_of(layers[:, i], truth) for i in range(layers.shape[1])]
    sums = [sum(row.values()) for row in rows]
    named = {f"loss/{name}": value for name, value in rows[-1].items()}
    named |= {f"loss/dec{i}_loss_recon": total for i, total in enumerate(sums)}
    return named | {"loss/loss_recon": sums[-1], "loss/loss": sum(sums)}


def _losses_of(points: np.ndarray, truth: MultiViewBatch) -> dict[str, float]:
    joints, vertices = split_queries(points, CONFIGS["petr"].query_order)[::-1]
    K, T, _ = (np.asarray(leaf, np.float64) for leaf in truth.cameras)
    cam = joints[:, None] @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]
    homogeneous = cam @ np.swapaxes(K, -1, -2)
    gap_px = homogeneous[..., :2] / homogeneous[..., 2:] - truth.keypoints_px
    on_mesh = [joints_from_vertices(hand(), v) for v in (vertices, truth.vertices_world)]
    return {
        "loss_3d_joints": np.mean((joints - truth.joints_world) ** 2),
        "loss_3d_joints_from_mesh": np.mean((on_mesh[0] - on_mesh[1]) ** 2),
        "loss_3d_verts": np.mean(np.abs(vertices - truth.vertices_world)),
        "loss_2d_joints": np.mean(np.sum(np.clip(gap_px / DIAGONAL_PX, -1, 1) ** 2, -1)),
    }


def check_loss(case: Case, key: str) -> None:
    np.testing.assert_allclose(losses(case)[key], case.stored[key], rtol=1e-4)


TERMS = ("loss_3d_joints", "loss_3d_joints_from_mesh", "loss_3d_verts", "loss_2d_joints")
SUMS = ("loss_recon", "loss")
"""Of the last layer, and of all."""
CHECKS: dict[str, Callable[[Case, str], None]] = {
    "all_coords_preds": check_points,
    **{f"loss/{term}": check_loss for term in (*TERMS, *SUMS)},
    **{f"loss/dec{i}_loss_recon": check_loss for i in range(6)},
}


def checks(case: Case) -> dict[str, Callable[[Case, str], None]]:
    """Say what is done with each array that is stored of a case; the intermediates are all of set a."""
    if case.inputs != "a":
        return CHECKS
    more = dict.fromkeys(STAGE_CHECKS[case.model], check_stage)
    return CHECKS | more | ({"template_mesh": check_unused_template} if case.model == "ftl" else {})


COMPARED = [(case, key, check) for case in CASES for key, check in checks(case).items()]


@pytest.mark.parity
@pytest.mark.parametrize(
    ("case", "key", "check"), [pytest.param(*row, id=f"{row[0]}-{row[1]}") for row in COMPARED]
)
def test_stored_arrays(case: Case, key: str, check: Callable[[Case, str], None]) -> None:
    check(case, key)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_every_stored_array_is_compared(case: Case) -> None:
    assert {key for compared, key, _ in COMPARED if compared == case} == case.stored.keys()


# Masks.


@pytest.mark.parity
@pytest.mark.parametrize("name", CONFIGS)
def test_masked_views_change_nothing(name: str) -> None:
    masked = run(name, amid_garbage(batch_of("a"))).prediction.layers_world
    alone = ran(Case(name, "a")).prediction.layers_world
    assert np.linalg.norm(masked - alone, axis=-1).max() <= ALIKE_M
