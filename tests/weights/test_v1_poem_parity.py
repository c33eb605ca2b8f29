"""The released POEM v1 and its ablations, on procedural weights and the stored basis points, against what the
authors' code stored.

The tables are what the tests run over; `test_every_stored_array_is_compared` sees to it that none is missing
from them. What comes before the first neighbour search agrees to 1e-5 of its largest number. After it a query
may read another 16th neighbour where two are equally near, so the points have gates of percentiles. Where
lists of neighbours are stored, of the first search of each kind, they are injected, and the features after
them agree as those before.

Sets a and b are one batch, the views of set a padded to the eight of set b, so that a model's float32 program
is compiled once. Unpadded, set a runs in float64 (the recorded models), set b in `test_v1_import.py`.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.data.batching import pad_views
from poem_jax.geometry.cameras import Cameras
from poem_jax.geometry.neighbours import nearest
from poem_jax.hand.model import template_queries
from poem_jax.hand.topology import WRIST
from poem_jax.losses import V1, multi_view_losses
from poem_jax.models import heat_maps, poem_v1, poem_v1_release, vector_attention
from poem_jax.models.backbones import ResNet
from poem_jax.models.ball_query import in_ball
from poem_jax.models.frustum import denormalised, normalised, view_row_column_code
from poem_jax.models.frustum_config import Cuboid
from poem_jax.models.layers import NormMode
from poem_jax.models.poem_v1 import PoemV1
from poem_jax.models.poem_v1_config import PoemV1Config
from poem_jax.models.poem_v1_release import (
    OwnCameraRelease,
    ProjectedRelease,
    UnnormalisedAggregation,
    _MixedEmbedding,
)
from poem_jax.models.poem_v1_start import ReleaseStart
from poem_jax.models.point_features import ViewRowColumnCode
from poem_jax.models.presets import released as released_config
from poem_jax.models.vector_attention import BracketedVectorAttention
from poem_jax.models.world_frame import WorkingFrame, enter_working_frame
from poem_jax.typing import Array
from poem_jax.weights.v1_poem_keys import hand_prefixes, unused_shapes, used_rows
from tests.precision import as_float64
from tests.weights.listening import Ears, Heard, listening
from tests.weights.procedural import in_float32
from tests.weights.v1_procedural import (
    PLACES,
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

VARIANTS = {
    "poem": "v1",
    "poem_g": "v1-g-emb",
    "poem_gv": "v1-gv-emb",
    "poem_full": "v1-full-emb",
    "poem_woproj": "v1-wo-proj",
}
"""By the reference's names."""
CONFIGS: dict[str, PoemV1Config] = {name: released_config(v) for name, v in VARIANTS.items()}  # pyright: ignore[reportAssignmentType]
RECORDED = ("poem", "poem_woproj")
"""Models whose intermediates are stored, of set a."""
KEYPOINT_PX, JOINT_M = 1e-3, 1e-5
GATES_M = {50: 2e-5, 99: 3e-4, 100: 3e-3}
"""Percentiles of the distances of the points of a layer."""
STAGE = 1e-5
"""Largest difference of an intermediate, over its largest number."""
EDGE = 5
"""Grid points that may be on the other side of a ball's surface."""


class Case(NamedTuple):
    """A model and the inputs that it was run on."""

    model: str
    inputs: str

    def __str__(self) -> str:
        return f"{self.model}_{self.inputs}"

    @property
    def stored(self) -> dict[str, np.ndarray]:
        return golden(str(self))

    @property
    def is_recorded(self) -> bool:
        return self.inputs == "a" and self.model in RECORDED


CASES = [Case(model, inputs) for model in CONFIGS for inputs in "ab"]
VIEWS = 8
"""Those of set b; set a has 4."""


# Names and shapes.


@pytest.mark.parametrize("name", CONFIGS)
def test_the_tables_are_the_manifest(name: str) -> None:
    """All names and shapes; every array that an output depends on, and no other; counters of ordinary norms
    alone."""
    config, entries = CONFIGS[name], {entry.name: entry for entry in manifest(name)}
    rows, unused = {row.source for row in used_rows(config)}, dict(unused_shapes(config))
    held = {entry.name for entry in entries.values() if entry.hand_field is not None}
    assert len(rows) == len(list(used_rows(config)))
    assert rows.isdisjoint(unused)
    assert rows | unused.keys() | held == entries.keys()
    assert {entry: entries[entry].shape for entry in unused} == unused
    assert all(entries[row].used for row in rows)
    assert not any(entries[entry].used for entry in unused)
    assert not any(entry.alias_of for entry in entries.values())
    frozen = {entry.name for entry in entries.values() if entry.kind.startswith("frozen")}
    trained = {row.source for row in used_rows(config) if row.path.startswith("trainable.")}
    assert trained.isdisjoint(frozen)
    assert {entry for entry in rows if entries[entry].kind == "param"} == trained
    for prefix, used in hand_prefixes(config).items():
        assert used == any(entries[entry].used for entry in held if entry.startswith(prefix))


# Runs.


def _whole(args: tuple, out: Any) -> Any:
    return out


HEARD: Ears = {
    "levels": (ResNet, "__call__", _whole),
    "uv_pooled": (heat_maps, "max_pool", _whole),
    "feat_pooled": (poem_v1_release, "max_pool", _whole),
    "grid": (poem_v1, "frustum_grid", _whole),
    "channels": (poem_v1_release, "frustum_channels", _whole),
    "row_column": (ViewRowColumnCode, "__call__", _whole),
    "start": (ReleaseStart, "__call__", _whole),
    "sampled": (ProjectedRelease, "sampled", _whole),
    "fused": (UnnormalisedAggregation, "__call__", _whole),
    "own": (OwnCameraRelease, "__call__", lambda args, out: out[0]),
    "embedding": (_MixedEmbedding, "__call__", _whole),
    "among": (BracketedVectorAttention, "among_queries", _whole),
    "to_basis": (BracketedVectorAttention, "to_basis", _whole),
    "searched": (vector_attention, "nearest", lambda args, out: (*args[:2], out)),
}
"""What is kept of every call of a function or method, in the order of the calls."""


@contextmanager
def neighbours_given(lists: list[Array | None]) -> Iterator[None]:
    """Let the n-th search find `lists[n]` in as many samples as that has."""
    searches = itertools.count()

    def find(queries: Array, points: Array, k: int) -> Array:
        found, n = nearest(queries, points, k), next(searches)
        given = lists[n] if n < len(lists) else None
        return found if given is None else found.at[: len(given)].set(given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vector_attention, "nearest", find)
        yield


class Run(NamedTuple):
    prediction: Prediction
    heard: Heard


@functools.lru_cache(maxsize=1)
def released(name: str) -> PoemV1:
    model = PoemV1(CONFIGS[name], hand(), rngs=nnx.Rngs(0))
    load_rows(model, list(used_rows(CONFIGS[name])), state_dict(name))
    return model


class Start(NamedTuple):
    """Where the second stage starts."""

    queries: Array
    centre: Array
    in_ball: Array
    """How many grid points the ball about the centre holds."""


@nnx.jit
def _run(model: PoemV1, views: Array, frame: WorkingFrame, ball_index: Array) -> tuple[Prediction, Start]:
    with listening({name: HEARD[name] for name in ("grid", "start")}) as heard:
        prediction = model.find_hands(model.look(views, NormMode()), frame, NormMode(), ball_index=ball_index)
    start, grid = heard["start"][0], heard["grid"][0]
    points = grid.reshape(*views.shape[:2], -1, 3)
    inside = in_ball(model.config.basis, points, start.centre)
    count = jnp.sum(inside & frame.cams.view_mask[..., None], (1, 2))
    return prediction, Start(start.queries, start.centre, count)


@nnx.jit
def _run_heard(
    model: PoemV1, views: Array, frame: WorkingFrame, ball_index: Array, lists: list[Array | None]
) -> tuple[Prediction, Heard]:
    with neighbours_given(lists), listening(HEARD) as heard:
        prediction = model.find_hands(model.look(views, NormMode()), frame, NormMode(), ball_index=ball_index)
    second, start = model.second, model.start
    queries = heard["start"][0].queries
    heard["heat"] = [jax.nn.sigmoid(model.heat_maps.to_logits(heard["uv_pooled"][0]))]
    heard["mlvl_feat"] = [model.features.squeeze(heard["feat_pooled"][0])]
    heard["input_proj"] = [model.features.project(heard["mlvl_feat"][0])]
    channels = heard["channels"][0]
    hidden = second.position_code.hidden(channels.reshape(-1, *channels.shape[2:]))
    heard["encoded"] = [second.position_code.out(jax.nn.relu(hidden))]
    heard["shift"] = [start.shift(jax.nn.relu(start.shift_hidden(jnp.swapaxes(queries, 1, 2))))]
    return prediction, dict(heard)


@functools.cache
def padded(inputs: str) -> MultiViewBatch:
    return pad_views(batch_of(inputs), VIEWS)


def rows_of(inputs: str, tree: Any) -> Any:
    """Take a set out of both, which stand one after the other."""
    count = len(batch_of("a").views)
    return jax.tree.map(lambda leaf: leaf[:count] if inputs == "a" else leaf[count:], tree)


def run(name: str, set_a: MultiViewBatch, ball_index: np.ndarray) -> tuple[Prediction, Start]:
    """Run set a, or what stands for it, together with set b."""
    sets, indices = (set_a, padded("b")), (ball_index, Case(name, "b").stored["ball_index"])
    views = np.concatenate([batch.views for batch in sets])
    cams = Cameras(*map(np.concatenate, zip(*(batch.cameras for batch in sets), strict=True)))
    frame = enter_working_frame(views, cams, None, np.float32)
    found = _run(released(name), views, frame, np.concatenate(indices))
    return jax.tree.map(np.asarray, found)


@functools.cache
def both(name: str) -> tuple[Prediction, Start]:
    return run(name, padded("a"), Case(name, "a").stored["ball_index"])


def _ran(case: Case) -> tuple[Prediction, Start]:
    return rows_of(case.inputs, both(case.model))


def ran(case: Case) -> Prediction:
    return _ran(case)[0]


SEARCHES = ("knn/pts_self_s0", "knn/query_self_0", "knn/query_cross_0")
"""In the order in which they are made; of the first only sample 0 is stored."""


@functools.cache
def heard_of(model: str) -> Run:
    """Run in float64, where only the stored numbers are rounded, with the stored lists of neighbours."""
    case = Case(model, "a")
    batch, stored = batch_of("a"), case.stored
    lists = [stored[key].astype(np.int32) for key in SEARCHES]
    lists[0] = lists[0][None]
    graph, state = nnx.split(released(model))
    with jax.enable_x64(True):
        doubled = nnx.merge(graph, as_float64(state))
        frame = enter_working_frame(batch.views, batch.cameras, None, np.float64)
        found = _run_heard(doubled, batch.views, frame, stored["ball_index"], lists)
        return Run(*jax.tree.map(np.asarray, found))


# What comes out.


def assert_within_gates(ours: np.ndarray, theirs: np.ndarray) -> None:
    """Compare points (batch, layer, 799, 3), layer by layer."""
    distance = np.linalg.norm(ours.astype(np.float64) - theirs, axis=-1)
    for layer in range(distance.shape[1]):
        found = {q: float(np.percentile(distance[:, layer], q)) for q in GATES_M}
        assert all(found[q] <= gate for q, gate in GATES_M.items()), (layer, found)


def check_points(case: Case, key: str) -> None:
    assert_within_gates(ran(case).layers_world, np.moveaxis(case.stored[key], 0, 1))


def check_keypoints(case: Case, key: str) -> None:
    views = batch_of(case.inputs).views.shape[1]
    ours = ran(case).keypoints_px[:, :views]
    np.testing.assert_allclose(ours, case.stored[key], atol=KEYPOINT_PX)


def check_joints(case: Case, key: str) -> None:
    np.testing.assert_allclose(ran(case).reference_joints_world, case.stored[key], atol=JOINT_M)


def check_injected(case: Case, key: str) -> None:
    """Given to the run; they are different points of the grids of all views."""
    index, views = case.stored[key], batch_of(case.inputs).views.shape[1]
    draw = CONFIGS[case.model].grid_draw
    assert draw is not None
    assert index.min() >= 0
    assert index.max() < views * draw.points_per_view
    assert all(len(set(row)) == draw.num_points for row in index)


def check_first_queries(case: Case, key: str) -> None:
    np.testing.assert_allclose(_ran(case)[1].queries, case.stored[key], atol=JOINT_M)


def check_centre(case: Case, key: str) -> None:
    np.testing.assert_allclose(_ran(case)[1].centre, case.stored[key], atol=JOINT_M)


def check_count(case: Case, key: str) -> None:
    """Rounding may put points of the surface on either side."""
    np.testing.assert_allclose(_ran(case)[1].in_ball, case.stored[key], atol=EDGE)


@functools.cache
def losses(case: Case) -> dict[str, float]:
    """The release's training loss of our points, under the stored names."""
    return _losses_of(case, ran(case))


@functools.cache
def losses_of_stored(case: Case) -> dict[str, float]:
    """The same of the stored points."""
    points = np.moveaxis(case.stored["all_coords_preds"], 0, 1)
    return _losses_of(case, ran(case)._replace(layers_world=points))


def _losses_of(case: Case, found: Prediction) -> dict[str, float]:
    batch = in_float32(padded(case.inputs))
    evaluate = jax.jit(
        functools.partial(
            multi_view_losses,
            image_hw=(256, 256),
            recipe=V1,
            query_order=CONFIGS[case.model].query_order,
        )
    )
    named: dict[str, float] = {}
    for i in range(found.layers_world.shape[1]):
        points = found.layers_world[:, i]
        layer = found._replace(joints_world=points[:, :21], vertices_world=points[:, 21:])
        total, terms = jax.tree.map(float, evaluate(layer, batch, hand=hand()))
        recon = sum(getattr(V1, ours) * terms[ours] for ours in LAYER_TERMS)
        named |= {f"loss/dec{i}_loss_recon": recon, "loss/loss_recon": recon, "loss/loss": total}
        named |= {f"loss/{theirs}": terms[ours] for ours, theirs in (LAYER_TERMS | OTHER_TERMS).items()}
    return named


def check_loss(case: Case, key: str) -> None:
    np.testing.assert_allclose(losses(case)[key], case.stored[key], rtol=1e-4)


def check_term_of_last_layer(case: Case, key: str) -> None:
    """One joint that hangs on a tie moves the mean over 21 by more than 1e-4 of itself, so that here the
    stored points count; the sums are of ours."""
    np.testing.assert_allclose(losses_of_stored(case)[key], case.stored[key], rtol=1e-4)


LAYER_TERMS = {
    "joints": "loss_3d_joints",
    "regressed_joints": "loss_3d_joints_from_mesh",
    "vertices": "loss_3d_verts",
    "reprojection": "loss_2d_joints",
}
OTHER_TERMS = {"keypoints": "loss_heatmap_joints", "triangulation": "loss_triangulated_joints"}
"""Our names of the losses, and the stored ones."""
SUMS = ("loss_recon", "loss", *(f"dec{i}_loss_recon" for i in range(6)))
OUTPUTS: dict[str, Callable[[Case, str], None]] = {
    "all_coords_preds": check_points,
    "pred_joints_uv": check_keypoints,
    "pred_ref_joints_3d": check_joints,
    "ball_index": check_injected,
    "reference_points_in": check_first_queries,
    "center_point": check_centre,
    "in_ball_count": check_count,
    **{f"loss/{name}": check_term_of_last_layer for name in LAYER_TERMS.values()},
    **{f"loss/{name}": check_loss for name in (*OTHER_TERMS.values(), *SUMS)},
}


# Stages, of set a.


def _channels_first(maps: np.ndarray) -> np.ndarray:
    return np.moveaxis(maps, -1, -3)


def _shares(points: np.ndarray) -> np.ndarray:
    cuboid = CONFIGS["poem"].space
    assert isinstance(cuboid, Cuboid)
    return np.asarray(normalised(jnp.asarray(points), cuboid))


def _sine(heard: Heard) -> np.ndarray:
    """Of view, row 5 and column 7."""
    return np.asarray(view_row_column_code(jnp.ones((2, 4), bool), (32, 32), 128))[:, :, 5, 7]


STAGES: dict[str, Callable[[Heard], np.ndarray]] = {
    **{
        f"backbone/res_layer{i + 1}": lambda heard, i=i: _channels_first(heard["levels"][0][i])[:1]
        for i in range(4)
    },
    "backbone/res_layer4_mean": lambda heard: heard["levels"][0][3].mean((1, 2)),
    "heatmap": lambda heard: _channels_first(heard["heat"][0]),
    "mlvl_feat_views01": lambda heard: _channels_first(heard["mlvl_feat"][0])[:2],
    "mlvl_feat_mean": lambda heard: heard["mlvl_feat"][0].mean((1, 2)),
    "input_proj_view0": lambda heard: _channels_first(heard["input_proj"][0])[0, ::8],
    "coords3d_abs_sub": lambda heard: heard["grid"][0][:, :, ::8, ::8, ::8],
    "position_encoder_in_view1": lambda heard: _channels_first(heard["channels"][0])[0, 1, :, ::4, ::4],
    "position_encoder_out_view1": lambda heard: _channels_first(heard["encoded"][0])[1, :, ::4, ::4],
    "adapt_view0": lambda heard: _channels_first(heard["row_column"][0])[0, 0, ::8],
    "sine_at_row5_col7": _sine,
    "center_shift": lambda heard: heard["shift"][0],
    "tr/query_xyz": lambda heard: _shares(heard["start"][0].queries),
    "tr/pt_xyz": lambda heard: heard["searched"][0][1],
    "tr/query_emb_s0": lambda heard: np.broadcast_to(heard["embedding"][0], (2, 799, 256))[0, :256],
}
PROJECTED: dict[str, Callable[[Heard], np.ndarray]] = {
    "pt_view_feats_s0": lambda heard: np.moveaxis(heard["sampled"][0][0, :, :64], 0, 1),
    "query_view_feats_s0": lambda heard: np.moveaxis(heard["sampled"][1][0, :, :64], 0, 1),
    "tr/pt_embed_s0": lambda heard: heard["sampled"][2][0, :, :256].sum(0),
    "tr/pt_feats_s0": lambda heard: heard["fused"][0][0, :256],
    "tr/query_feat_s0": lambda heard: heard["fused"][1][0, :256],
}
OWN_CAMERA: dict[str, Callable[[Heard], np.ndarray]] = {
    "tr/pt_feats_s0": lambda heard: heard["own"][0][0, :256],
}
AFTER_GIVEN: dict[str, Callable[[Heard], np.ndarray]] = {
    "tr/pts_self_s0": lambda heard: heard["among"][0][0, :256],
    "tr/query_self_0_s0": lambda heard: heard["among"][1][0, :128],
    "tr/query_cross_0_s0": lambda heard: heard["to_basis"][0][0, :128],
}
"""After searches whose neighbours were given."""
AFTER_SEARCH: dict[str, Callable[[Heard], np.ndarray]] = {
    **{f"tr/query_self_{i}_s0": lambda heard, i=i: heard["among"][1 + i][0, :128] for i in range(1, 6)},
    **{f"tr/query_cross_{i}_s0": lambda heard, i=i: heard["to_basis"][i][0, :128] for i in range(1, 6)},
}


def stages_of(model: str) -> dict[str, Callable[[Heard], np.ndarray]]:
    """List what agrees to rounding."""
    return STAGES | AFTER_GIVEN | (PROJECTED if model == "poem" else OWN_CAMERA)


def check_stage(case: Case, key: str) -> None:
    ours, theirs = stages_of(case.model)[key](heard_of(case.model).heard), case.stored[key]
    assert ours.shape == theirs.shape
    assert np.abs(ours - theirs).max() <= STAGE * np.abs(theirs).max()


def check_late_stage(case: Case, key: str) -> None:
    """Features that hang on searches have the gates of the points, over their largest number."""
    ours, theirs = AFTER_SEARCH[key](heard_of(case.model).heard), case.stored[key]
    assert ours.shape == theirs.shape
    gap = np.abs(ours - theirs) / np.abs(theirs).max()
    assert all(np.percentile(gap, q) <= gate for q, gate in GATES_M.items())


def check_layers(case: Case, key: str) -> None:
    """Points after every layer with the first searches' neighbours given; the stored ones are shares."""
    cuboid = CONFIGS[case.model].space
    assert isinstance(cuboid, Cuboid)
    theirs = denormalised(jnp.asarray(np.moveaxis(case.stored[key], 0, 1)), cuboid)
    assert_within_gates(heard_of(case.model).prediction.layers_world, np.asarray(theirs))


def check_neighbours(case: Case, key: str) -> None:
    """The stored neighbours are the nearest ones, rank by rank, to rounding."""
    queries, points, _ = heard_of(case.model).heard["searched"][SEARCHES.index(key)]
    for sample, index in enumerate(case.stored[key].reshape(-1, *case.stored[key].shape[-2:])):
        square = sum((queries[sample, :, None, i] - points[sample, None, :, i]) ** 2 for i in range(3))
        theirs = np.take_along_axis(square, index.astype(np.int32), -1)
        ours = np.sort(np.partition(square, 15, -1)[:, :16], -1)
        np.testing.assert_allclose(np.sqrt(theirs), np.sqrt(ours), atol=1e-6)


def check_template(case: Case, key: str) -> None:
    """The model with V-emb computes it, too, and reads it nowhere."""
    ours = template_queries(hand(), CONFIGS[case.model].query_order, center_joint=WRIST)
    np.testing.assert_allclose(ours, case.stored[key], atol=1e-7)


def checks(case: Case) -> dict[str, Callable[[Case, str], None]]:
    """Say what is done with each array that is stored of a case."""
    if not case.is_recorded:
        return OUTPUTS
    late = dict.fromkeys(AFTER_SEARCH, check_late_stage) | dict.fromkeys(SEARCHES, check_neighbours)
    late |= {"tr/query_xyz_layers_normalised": check_layers, "template_mesh": check_template}
    return OUTPUTS | dict.fromkeys(stages_of(case.model), check_stage) | late


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
@pytest.mark.parametrize("name", RECORDED)
def test_masked_views_change_nothing(name: str) -> None:
    """Basis points are numbered by view, so that their numbers move with the views."""
    draw = CONFIGS[name].grid_draw
    assert draw is not None
    index, size = golden(f"{name}_a")["ball_index"], draw.points_per_view
    moved = (np.array(PLACES)[index // size] * size + index % size).astype(np.int32)
    masked, _ = rows_of("a", run(name, amid_garbage(batch_of("a")), moved))
    assert_within_gates(masked.layers_world, ran(Case(name, "a")).layers_world)
    stored = golden(f"{name}_a")["all_coords_preds"]
    assert_within_gates(masked.layers_world, np.moveaxis(stored, 0, 1))
