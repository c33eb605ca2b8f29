"""Intermediates of the released models, and their stored float64 runs, all in float64.

There is no rounding on our side then: what differs is the rounding of the stored float32 arrays, and the
stored float64 runs are met at every point of every block, all neighbours found.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
import pytest
from scipy.special import erf

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.hand.topology import NUM_QUERIES, ROOT_JOINT
from poem_jax.models.world_frame import enter_working_frame
from tests.weights.halves import find_hands, look
from tests.weights.procedural import IMAGE_HW, batch_of, golden, needs_reference, released, weight
from tests.weights.ties import PARAMETRIC

pytestmark = [needs_reference, pytest.mark.parity]

RECORDED = ("small", "medium", "medium_MANO")
"""Models whose intermediates are stored, all of case A."""
NEGATIVE_SOLUTIONS = (True, False, True)
"""Samples whose root the release found as -v in place of v, the last singular vector: LAPACK's choice. It
divides by v[3] + 1e-7, so that the two differ by 2e-7 m, which is enough to turn ties between neighbours."""


class Exact(NamedTuple):
    """A model on case A in float64."""

    prediction: Prediction
    heard: dict[str, list]


@functools.cache
def exact(model: str) -> Exact:
    config, params = released(model)
    batch = batch_of("A")
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: np.asarray(leaf, _double(leaf.dtype)), params)
        seen, heard = look(params, batch.views, config=config)
        roots = released_roots(batch, np.asarray(seen.keypoints_px))
        nothing = np.zeros((4, len(roots), NUM_QUERIES), bool)
        frame = enter_working_frame(batch.views, batch.cameras, roots, np.float64)
        prediction, _, more = find_hands(params, seen, frame, nothing, config=config)
    return Exact(*jax.tree.map(np.asarray, (prediction, heard | more)))


def _double(dtype: np.dtype) -> np.dtype:
    return np.dtype(np.float64) if dtype.kind == "f" else dtype


def released_roots(batch: MultiViewBatch, keypoints_px: np.ndarray) -> np.ndarray:
    """Triangulate joint 9 as the release does, sign of the singular vector included."""
    roots = []
    for b, is_negative in enumerate(NEGATIVE_SOLUTIONS):
        seen = batch.cameras.view_mask[b]
        M = batch.cameras.K[b, seen].astype(np.float64) @ batch.cameras.T_cam_from_world[b, seen, :3]
        u, v = keypoints_px[b, seen, ROOT_JOINT].T[..., None]
        x = np.linalg.svd(np.concatenate([u * M[:, 2] - M[:, 0], v * M[:, 2] - M[:, 1]]))[2][-1]
        x *= np.sign(x[3]) * (-1 if is_negative else 1)
        roots.append(x[:3] / (x[3] + 1e-7))
    return np.stack(roots)


def channels_first(maps: np.ndarray) -> np.ndarray:
    return np.moveaxis(maps, -1, -3)


@functools.cache
def of_trunk() -> dict[str, np.ndarray]:
    """What does not depend on the width of a model, named as in `golden_shared_A`."""
    run, batch = exact("small"), batch_of("A")
    seen = batch.cameras.view_mask
    maps = {f"backbone_level{i}": level for i, level in enumerate(run.heard["levels"][0])}
    named = {"uv_logits_view0": channels_first(run.heard["uv_logits"][0])[0]}
    for name, x in {**maps, "mlvl_feat": run.heard["mlvl_feat"][0]}.items():
        named[f"{name}_view0"] = channels_first(x[0])
        named[f"{name}_chan_mean"] = x[seen.ravel()].mean((1, 2))
        named[f"{name}_chan_std"] = x[seen.ravel()].std((1, 2), ddof=1)
    named["pred_joints_uv"] = run.prediction.keypoints_px[seen]
    named["pred_ref_joints_3d"] = run.prediction.reference_joints_world
    return named


@functools.cache
def of_features(model: str) -> dict[str, np.ndarray]:
    """From the feature map to the basis features, named as in the golden of a model."""
    heard, seen = exact(model).heard, batch_of("A").cameras.view_mask
    sampled, uv_share = heard["sampled"][0]
    count = int(seen[0].sum())
    named = {"input_proj_view0": channels_first(heard["input_proj"][0][0])}
    named["pos_sample0"] = channels_first(heard["position"][0][0, :count])[:, ::4]
    named["sine_sample0_hw"] = channels_first(position_codes(*heard["place_codes"][0])[:count, ::5, ::5])
    uv_px = uv_share[seen] * IMAGE_HW[0]
    named["bps_uv_view0"], named["bps_uv_view_last"] = uv_px[0], uv_px[-1]
    named["sampled_feat_cols128"] = np.swapaxes(sampled[seen], -1, -2)
    named["merge_in_rows128_sample0"] = np.swapaxes(heard["tokens"][0][0, :count], 0, 1)
    named["basis_feat_rows64"] = heard["basis_features"][0]
    config, params = released(model)
    named["query_xyz_init"] = params["constants"]["template_queries"] / config.basis.radius
    return named


def position_codes(views: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Join the codes of the first sample's views, of rows and of columns, which ours mixes one by one."""
    views, rows = views[0, :, None, None], rows[:, None]
    shape = (len(views), len(rows), *columns.shape)
    return np.concatenate([np.broadcast_to(code, shape) for code in (views, rows, columns)], -1)


@functools.cache
def of_decoder(model: str) -> dict[str, np.ndarray]:
    """The rows of every block, named as in the golden of a model."""
    heard, named = exact(model).heard, {}
    for i in range(3):
        queries, tokens = heard["embedded"][2 * i]
        named |= {f"b{i}_query_emb_rows40": queries, f"b{i}_key_emb_rows256": tokens}
        for j, name in enumerate(("attn", "cross_attn")):
            named[f"b{i}_{name}_rows40"] = heard["norms"][3 * i + j]
        for name in ("vec_self", "vec_cross", "out"):
            named[f"b{i}_{name}_rows40"] = heard[name][i]
        if i > 0:
            basis, queries = heard["neighbours"][2 * (i - 1) : 2 * i]
            named[f"b{i}_cross_knn_idx_rows40"] = basis[:, ::40]
            named[f"b{i}_self_knn_idx_rows40"] = queries[:, ::40]
    if model != PARAMETRIC:
        named["b2_out_rows40"] = last_feed_forward(named["b2_vec_cross_rows40"])
    return named


def last_feed_forward(x: np.ndarray) -> np.ndarray:
    """The last feed-forward network, which no output depends on, so that our models do not have it."""
    width, source = x.shape[-1], "ptEmb_head.transformer.pt_metro_encoder.2.encoder"

    def linear(name: str, x: np.ndarray, c_out: int) -> np.ndarray:
        kernel = weight(f"{source}.{name}.weight", (c_out, x.shape[-1])).astype(np.float64)
        return x @ kernel.T + weight(f"{source}.{name}.bias", (c_out,))

    hidden = linear("intermediate.dense", x, 4 * width)
    x = x + linear("output.dense", hidden * (1 + erf(hidden / 2**0.5)) / 2, width)
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-12)
    gain, shift = (weight(f"{source}.output.LayerNorm.{name}", (width,)) for name in ("weight", "bias"))
    return x * gain + shift


# Comparisons. The tolerances are some times what float32 leaves in the stored arrays.

TRUNK = {
    **{f"backbone_level{i}_{what}": 1e-5 for i in range(4) for what in ("view0", "chan_mean", "chan_std")},
    **{f"mlvl_feat_{what}": 2e-5 for what in ("view0", "chan_mean", "chan_std")},
    "uv_logits_view0": 3e-5,
    "pred_joints_uv": 1e-3,
    "pred_ref_joints_3d": 1e-5,
}
FEATURES = {
    "input_proj_view0": 2e-5,
    "pos_sample0": 2e-6,
    "sine_sample0_hw": 2e-6,
    "bps_uv_view0": 1e-3,
    "bps_uv_view_last": 1e-3,
    "sampled_feat_cols128": 1e-4,
    "merge_in_rows128_sample0": 1e-4,
    "basis_feat_rows64": 1e-4,
    "query_xyz_init": 1e-6,
}
BEFORE_SEARCH = ("query_emb_rows40", "attn_rows40", "cross_attn_rows40")
AFTER_SEARCH = ("vec_self_rows40", "vec_cross_rows40", "out_rows40")
ROWS = {
    f"b{i}_{name}": atol for i, atol in enumerate((2e-4, 2e-4, 5e-4)) for name in BEFORE_SEARCH + AFTER_SEARCH
}
"""Attention makes errors grow from block to block."""
TOKENS = {f"b{i}_key_emb_rows256": 1e-4 for i in range(3)}
NEIGHBOURS = [f"b{i}_{target}_knn_idx_rows40" for i in (1, 2) for target in ("self", "cross")]
TIE = 1e-6
"""Squared distances, units of 10 cm, that float32 may order either way; the gap is typically 1e-3."""


NEAR_TIE = 2e-6
"""The same where the queries carry the rounding of a block: some 1e-6 m, at 3 cm from each other."""


def close(ours: np.ndarray, theirs: np.ndarray, atol: float) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol)


def check_trunk(file: str, key: str) -> None:
    close(of_trunk()[key], golden(file)[key], TRUNK[key])


def check_features(file: str, key: str) -> None:
    close(of_features(model_of(file))[key], golden(file)[key], FEATURES[key])


def check_tokens(file: str, key: str) -> None:
    close(of_decoder(model_of(file))[key], golden(file)[key], TOKENS[key])


def check_rows(file: str, key: str) -> None:
    """Compare the rows that the stored float32 run and its float64 run computed from the same neighbours."""
    kept = ~hang_on_ties(file, key)
    assert kept.mean() > 0.9
    close(of_decoder(model_of(file))[key][kept], golden(file)[key][kept], ROWS[key])


def hang_on_ties(file: str, key: str) -> np.ndarray:
    """Tell the rows (batch, row) that depend on a search that ended otherwise in the stored float32 run."""
    block, searched = int(key[1]), key[3:] in AFTER_SEARCH
    float32, float64 = (golden(file)[name][1] for name in ("all_coords_preds", "all_coords_preds_f64run"))
    moved = np.linalg.norm(float32 - float64, axis=-1) > 1e-5
    if block == 0 or (block == 1 and not searched):
        return np.zeros_like(moved[:, ::40])
    if block == 1 or not searched:
        return moved[:, ::40]
    read = of_decoder(model_of(file))["b2_self_knn_idx_rows40"]
    doubtful = moved
    if model_of(file) == PARAMETRIC:
        # Such a hand moves as a whole: its points do not show which of them searched otherwise.
        doubtful = moved | (search_gaps(PARAMETRIC, block=1) < NEAR_TIE)
    return moved[:, ::40] | np.stack([m[rows].any(-1) for m, rows in zip(doubtful, read, strict=True)])


def search_gaps(model: str, block: int) -> np.ndarray:
    """How much farther than the last neighbour the next point is, (batch, query), squared, units of 10 cm."""
    queries, basis = search_points(model, block)
    count = exact(model).heard["neighbours"][0].shape[-1]
    gaps = []
    for points in queries:
        square = [np.sort(np.sum((points[:, None] - x) ** 2, -1), axis=1) for x in (points, basis)]
        gaps.append(np.minimum(*(d[:, count] - d[:, count - 1] for d in square)))
    return np.stack(gaps)


def check_neighbours(file: str, key: str) -> None:
    """Compare sets: where they differ, the points in question are equally far."""
    ours, theirs = of_decoder(model_of(file))[key], golden(file)[key]
    queries, basis = search_points(model_of(file), block=int(key[1]))
    for sample, row in np.ndindex(ours.shape[:2]):
        differing = sorted(set(ours[sample, row]) ^ set(theirs[sample, row]))
        points = queries[sample] if "self" in key else basis
        square = np.sum((points[differing] - queries[sample, 40 * row]) ** 2, -1)
        assert np.ptp(square, initial=0) <= TIE if differing else True


def search_points(model: str, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the queries and the basis points among which a block searches, units of 10 cm."""
    config, params = released(model)
    prediction = exact(model).prediction
    queries = prediction.layers_world[:, block - 1] - prediction.root_world[:, None]
    return queries / config.basis.radius, params["constants"]["basis_points"] / config.basis.radius


def check_float64_run(file: str, key: str) -> None:
    """No quantile here: float64 leaves no ties. The release's position code stays float32."""
    close(exact(model_of(file)).prediction.layers_world, golden(file)[key], 3e-7)


def check_float64_keypoints(file: str, key: str) -> None:
    """Compare how far the stored float32 key points are from the float64 ones."""
    ours = exact(model_of(file)).prediction.keypoints_px[batch_of("A").cameras.view_mask]
    close(np.abs(ours - golden(file)["pred_joints_uv"]).max(), golden(file)[key], 1e-5)


def model_of(file: str) -> str:
    return file.removesuffix("_A")


CHECKS: dict[str, Callable[[str, str], None]] = {
    **dict.fromkeys(FEATURES, check_features),
    **dict.fromkeys(ROWS, check_rows),
    **dict.fromkeys(TOKENS, check_tokens),
    **dict.fromkeys(NEIGHBOURS, check_neighbours),
    "all_coords_preds_f64run": check_float64_run,
    "uv_f64run_maxdiff": check_float64_keypoints,
}
COMPARED = [("shared_A", key, check_trunk) for key in TRUNK]
COMPARED += [
    (f"{model}_A", key, check)
    for model, key in itertools.product(RECORDED, CHECKS)
    for check in [CHECKS[key]]
]


@pytest.mark.parametrize(
    ("file", "key", "check"), [pytest.param(*row, id=f"{row[0]}-{row[1]}") for row in COMPARED]
)
def test_stored_array(file: str, key: str, check: Callable[[str, str], None]) -> None:
    check(file, key)
