"""`evaluate` and its parts against what the unmodified official evaluators return, key by key."""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from poem_jax.evaluation.alignment import align, fit_similarity, scale_translation, subtract_wrist
from poem_jax.evaluation.metrics import (
    area_under_curve,
    evaluate,
    f_scores,
    mean_error,
    median_error,
    pck_curve,
    point_distances,
)
from poem_jax.evaluation.protocols import PROTOCOLS, find_protocol
from poem_jax.hand.mano_file import load

REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "reference"
GOLDEN = REFERENCE / "metrics" / "official_golden.npz"
RELEASE_GOLDEN = REFERENCE / "poem_v2" / "golden_metrics.npz"
V1_GOLDEN = REFERENCE / "poem_v1" / "golden_transform_metrics.npz"
V1_METRICS = {
    **{f"metric/auc_{x}_0.0{cm}": f"auc_{x}_{10 * cm}" for x in "jv" for cm in (2, 5)},
    **{f"metric/{p}mp{x}pe": f"{p}mp{x}pe_mm" for p in ("", "pa_") for x in "jv"},
}
"""What POEM v1's own evaluation gave for five predictions, by our names."""
V1_POINTS = tuple(f"metric/{key}" for key in ("pred_joints", "gt_joints", "pred_verts", "gt_verts"))
SETS = ("regular", "all")
INPUT_KEYS = {"gt_joints", "gt_verts", "pred_joints", "pred_verts", "kind", "noise_sigma_m", "seed"} | {
    f"{name}_mask" for name in SETS
}
"""Keys that describe the inputs: there is nothing to compare them with."""

# Printed with six decimals, so half of the last one is the resolution.
OFFICIAL_SCORES = {
    "freihand": {
        "xyz_mean3d": "mpjpe_mm",
        "xyz_auc3d": "auc_j_50",
        "xyz_al_mean3d": "pa_mpjpe_mm",
        "xyz_al_auc3d": "pa_auc_j_50",
        "mesh_mean3d": "mpvpe_mm",
        "mesh_auc3d": "auc_v_50",
        "mesh_al_mean3d": "pa_mpvpe_mm",
        "mesh_al_auc3d": "pa_auc_v_50",
        "f_score_5": "f_5",
        "f_al_score_5": "pa_f_5",
        "f_score_15": "f_15",
        "f_al_score_15": "pa_f_15",
    },
    "dexycb": {
        "absolute/mpjpe": "mpjpe_mm",
        "absolute/auc": "auc_j_50",
        "root-relative/mpjpe": "rr_mpjpe_mm",
        "root-relative/auc": "rr_auc_j_50",
        "procrustes/mpjpe": "pa_mpjpe_mm",
        "procrustes/auc": "pa_auc_j_50",
    },
    "poem": {
        **{f"{p}auc_{s}_{t}": f"{p}auc_{s}_{t}" for p in ("", "rr_") for s in "jv" for t in (20, 50)},
        **{f"{p}mp{s}pe": f"{p}mp{s}pe_mm" for p in ("", "rr_", "pa_") for s in "jv"},
        "mpjpe_paeval": "mpjpe_mm",
        "mpvpe_paeval": "mpvpe_mm",
    },
}
OFFICIAL_SCORES["ho3d"] = {
    key.replace("xyz_al_", "xyz_procrustes_al_"): name for key, name in OFFICIAL_SCORES["freihand"].items()
} | {"xyz_scale_trans_al_mean3d": "sc_tr_mpjpe_mm", "xyz_scale_trans_al_auc3d": "sc_tr_auc_j_50"}
MM_PER_OFFICIAL_UNIT = {"freihand": 10.0, "ho3d": 10.0, "dexycb": 1.0, "poem": 1000.0}
PRINTED_DIGITS = {"freihand": 0.5e-6, "ho3d": 0.5e-6, "dexycb": 0.0, "poem": 0.0}

SCORE_CASES = [
    (subset, name, key) for subset in SETS for name, table in OFFICIAL_SCORES.items() for key in table
]
CURVE_SETS = ("xyz", "xyz_pa", "xyz_rr", "xyz_sc_tr", "mesh", "mesh_pa")
CURVE_CASES = [
    (subset, curve, key)
    for subset in SETS
    for curve in CURVE_SETS
    for key in ("mean_m", "median_m", "auc_50", "auc_20", "pck_50", "pck_20")
]
POEM_CURVE_CASES = [
    (subset, prefix, key, limit_mm)
    for subset in SETS
    for prefix in ("", "rr_")
    for key in ("auc_j_per_kp", "thresholds")
    for limit_mm in (20, 50)
]
PER_SAMPLE_KEYS = (
    "procrustes_joints",
    "procrustes_verts",
    "procrustes_R",
    "procrustes_s",
    "procrustes_s1",
    "procrustes_t",
    "procrustes_det_R",
    "sc_tr_joints_ho3d",
    "err_joints_mm",
    "err_joints_rr_mm",
    "err_joints_pa_mm",
    "err_verts_mm",
    "err_verts_pa_mm",
    "fscore_precision_recall",
    "fscore_precision_recall_pa",
)

needs_golden = pytest.mark.skipif(not GOLDEN.is_file(), reason="reference material (../shared) is absent")
pytestmark = [needs_golden, pytest.mark.parity]


@cache
def golden() -> dict[str, np.ndarray]:
    return dict(np.load(GOLDEN))


@cache
def scores(subset: str, protocol: str) -> dict[str, float]:
    data, mask = golden(), golden()[f"{subset}_mask"]
    points = (data[key][mask] for key in ("pred_joints", "gt_joints", "pred_verts", "gt_verts"))
    return evaluate(*points, protocol=protocol)


@cache
def moved(curve: str) -> tuple[np.ndarray, np.ndarray]:
    """The prediction and ground truth of a curve, in metres, for all samples."""
    data = golden()
    pred, gt = data["pred_joints"], data["gt_joints"]
    if curve == "xyz_rr":
        return subtract_wrist(pred, pred), subtract_wrist(gt, gt)
    if curve == "xyz_sc_tr":
        return scale_translation(pred, gt), gt
    if curve.startswith("mesh"):
        pred, gt = data["pred_verts"], data["gt_verts"]
    return (align(pred, gt) if curve.endswith("_pa") else pred), gt


@pytest.mark.parametrize(("subset", "name", "key"), SCORE_CASES)
def test_scores_equal_the_official_evaluator(subset: str, name: str, key: str) -> None:
    expected = golden()[f"{subset}/{name}/{key}"]
    metric = OFFICIAL_SCORES[name][key]
    unit = MM_PER_OFFICIAL_UNIT[name] if metric.endswith("_mm") else 1.0
    got = scores(subset, name)[metric] / unit
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=PRINTED_DIGITS[name])


@pytest.mark.parametrize(("subset", "curve", "key"), CURVE_CASES)
def test_curves_equal_evalutil(subset: str, curve: str, key: str) -> None:
    mask = golden()[f"{subset}_mask"]
    pred, gt = moved(curve)
    distances = point_distances(pred[mask], gt[mask])
    if key == "mean_m":
        got = mean_error(distances)
    elif key == "median_m":
        got = median_error(distances)
    else:
        thresholds = find_protocol("freihand").auc_thresholds(int(key[-2:]))
        curves = {"auc": lambda: area_under_curve(distances, thresholds).mean()}
        curves["pck"] = lambda: pck_curve(distances, thresholds).mean(1)
        got = curves[key[:3]]()
    np.testing.assert_allclose(got, golden()[f"{subset}/evalutil100/{curve}/{key}"], rtol=1e-9)


@pytest.mark.parametrize(("subset", "prefix", "key", "limit_mm"), POEM_CURVE_CASES)
def test_poem_areas_per_joint(subset: str, prefix: str, key: str, limit_mm: int) -> None:
    expected = golden()[f"{subset}/poem/{prefix}{key}_{limit_mm}"]
    mask, thresholds = golden()[f"{subset}_mask"], find_protocol("poem").auc_thresholds(limit_mm)
    pred, gt = moved("xyz_rr" if prefix else "xyz")
    got = thresholds
    if key == "auc_j_per_kp":
        got = area_under_curve(point_distances(pred[mask], gt[mask]), thresholds)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-15)


def per_sample(key: str) -> np.ndarray:
    """What the golden holds under `key`, computed here."""
    errors = {
        "joints": "xyz",
        "verts": "mesh",
        "joints_rr": "xyz_rr",
        "joints_pa": "xyz_pa",
        "verts_pa": "mesh_pa",
    }
    if match := re.fullmatch(r"err_(\w+)_mm", key):
        return 1000 * point_distances(*moved(errors[match[1]]))
    if key.startswith("fscore"):
        pred, gt = moved("mesh_pa" if key.endswith("_pa") else "mesh")
        parts = f_scores(pred, gt, np.array([0.005, 0.015]))
        return np.stack([parts.f, parts.recall, parts.precision], axis=-1)
    if key.startswith("sc_tr"):
        return moved("xyz_sc_tr")[0]
    return procrustes_parts(golden()["pred_joints"], golden()["gt_joints"])[key]


def procrustes_parts(pred: np.ndarray, gt: np.ndarray) -> dict[str, np.ndarray]:
    """The official names for a fit: `s` is the scale between sets of norm 1, `t` the shift of the means."""
    fit = fit_similarity(pred, gt)
    pred_norm, gt_norm = (
        np.linalg.norm(x - x.mean(1, keepdims=True), axis=(1, 2)) + 1e-8 for x in (pred, gt)
    )
    return {
        "procrustes_joints": align(pred, gt),
        "procrustes_verts": moved("mesh_pa")[0],
        "procrustes_R": fit.R,
        "procrustes_s": fit.scale * pred_norm / gt_norm,
        "procrustes_s1": gt_norm,
        "procrustes_t": gt.mean(1) - pred.mean(1),
        "procrustes_det_R": np.linalg.det(fit.R),
    }


@pytest.mark.parametrize("key", PER_SAMPLE_KEYS)
def test_per_sample_arrays(key: str) -> None:
    got, expected = per_sample(key), golden()[key]
    if key in ("procrustes_R", "procrustes_det_R"):
        # A planar or collapsed prediction leaves the rotation open; only its aligned points are determined.
        determined = ~np.isin(golden()["kind"], ["planar_prediction", "zero_prediction"])
        got, expected = got[determined], expected[determined]
    # Aligned errors of perfect predictions are about 1e-6 mm, a difference of numbers near 1 m.
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-12)


def test_every_key_of_the_golden_is_compared() -> None:
    compared = {f"{subset}/{name}/{key}" for subset, name, key in SCORE_CASES}
    compared |= {f"{subset}/evalutil100/{curve}/{key}" for subset, curve, key in CURVE_CASES}
    compared |= {f"{subset}/poem/{prefix}{key}_{limit}" for subset, prefix, key, limit in POEM_CURVE_CASES}
    compared |= set(PER_SAMPLE_KEYS)
    assert compared.isdisjoint(INPUT_KEYS)
    assert set(golden()) == compared | INPUT_KEYS


def test_protocols_of_the_golden_are_all_known() -> None:
    # The release's own evaluation has a golden of its own, below.
    assert set(OFFICIAL_SCORES) == set(PROTOCOLS) - {"poem-release"}


def test_the_dexycb_unit_shows_in_the_tenth_digit() -> None:
    """The epsilon of the alignment is 1e-8 of the data's unit: millimetres in DexYCB, metres elsewhere."""
    in_mm, in_m = scores("regular", "dexycb")["pa_mpjpe_mm"], scores("regular", "poem")["pa_mpjpe_mm"]
    np.testing.assert_allclose([in_mm, in_m], [6.573265636, 6.573266379], atol=1e-9)


def test_perfect_aligned_prediction_misses_the_zero_threshold() -> None:
    data, perfect = golden(), golden()["kind"] == "perfect"
    points = [data[key][perfect] for key in ("pred_joints", "gt_joints", "pred_verts", "gt_verts")]
    got = evaluate(*points, protocol="freihand")
    assert got["auc_j_50"] == got["auc_v_50"] == got["f_5"] == got["pa_f_15"] == 1.0
    np.testing.assert_allclose([got["pa_auc_j_50"], got["pa_auc_v_50"]], 1 - 0.5 / 99, rtol=1e-12)


@cache
def release() -> tuple[dict[str, np.ndarray], dict]:
    """Arrays and numbers of the release's own run on 100 predictions."""
    return dict(np.load(RELEASE_GOLDEN)), json.loads(RELEASE_GOLDEN.with_suffix(".json").read_text())


def test_release_errors_and_areas_of_direct_joints() -> None:
    data, numbers = release()
    got = evaluate(
        data["pred_joints"], data["gt_joints"], data["pred_verts"], data["gt_verts"], protocol="poem"
    )
    for limit_mm in (20, 50):
        for letter in "jv":
            expected = numbers[f"AUC_{letter.upper()}_{limit_mm}mm"]
            np.testing.assert_allclose(got[f"auc_{letter}_{limit_mm}"], expected, rtol=1e-6)
    np.testing.assert_allclose(got["mpjpe_mm"], 1000 * numbers["MPJPE_direct_joints"], rtol=1e-6)
    for name, expected in numbers["PAEval_direct_joints"].items():
        np.testing.assert_allclose(got[f"{name}_mm"], 1000 * expected, rtol=1e-5)


def test_release_errors_of_joints_of_the_mesh() -> None:
    data, numbers = release()
    got = evaluate(
        data["pred_joints_from_mesh"],
        data["gt_joints_from_mesh"],
        data["pred_verts"],
        data["gt_verts"],
        protocol="poem",
    )
    for name, expected in numbers["PAEval_from_mesh"].items():
        np.testing.assert_allclose(got[f"{name}_mm"], 1000 * expected, rtol=1e-5)
    np.testing.assert_allclose(got["rr_mpjpe_mm"], 1000 * numbers["RR_J_root0_from_mesh"], rtol=1e-6)
    expected = 1000 * numbers["RR_V_root0_from_mesh_joint"]
    np.testing.assert_allclose(got["rr_mpvpe_mm"], expected, rtol=1e-6)


def test_the_protocol_of_the_release_regresses_its_joints() -> None:
    """All numbers of the released evaluation from one call on direct joints and meshes."""
    data, numbers = release()
    hand = load(RELEASE_GOLDEN.parent / "fake_mano.npz")
    points = [data[key] for key in ("pred_joints", "gt_joints", "pred_verts", "gt_verts")]
    got = evaluate(*points, protocol="poem-release", hand=hand)
    expected = {f"{name}_mm": 1000 * value for name, value in numbers["PAEval_from_mesh"].items()}
    expected |= {
        "rr_mpjpe_mm": 1000 * numbers["RR_J_root0_from_mesh"],
        "rr_mpvpe_mm": 1000 * numbers["RR_V_root0_from_mesh_joint"],
    }
    expected |= {f"auc_{x}_{mm}": numbers[f"AUC_{x.upper()}_{mm}mm"] for x in "jv" for mm in (20, 50)}
    for name, value in expected.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-5, err_msg=name)
    np.testing.assert_allclose(got["mpjpe_mm"], 1000 * numbers["MPJPE_from_mesh"], rtol=1e-6)
    with pytest.raises(ValueError, match="regresses joints from vertices: give `hand`"):
        evaluate(*points, protocol="poem-release")


def test_release_curves() -> None:
    data, _ = release()
    joints = point_distances(data["pred_joints"].astype(float), data["gt_joints"].astype(float))
    vertices = point_distances(data["pred_verts"].astype(float), data["gt_verts"].astype(float))
    for limit_mm in (20, 50):
        thresholds = find_protocol("poem").auc_thresholds(limit_mm)
        np.testing.assert_allclose(thresholds, data[f"auc_thresholds_{limit_mm}mm"])
        areas = area_under_curve(joints, thresholds)
        np.testing.assert_allclose(areas, data[f"auc_J_per_kp_{limit_mm}mm"], rtol=1e-6)
        areas = area_under_curve(vertices, thresholds)
        np.testing.assert_allclose(areas, data[f"auc_V_per_kp_{limit_mm}mm"], rtol=1e-6)
        curve = pck_curve(joints, thresholds).mean(1)
        np.testing.assert_allclose(curve, data[f"pck_J_curve_mean_{limit_mm}mm"], rtol=1e-6)


def test_release_alignment() -> None:
    # The release aligns in float32; the mirrored sample 3 and the shifted sample 5 are among these.
    data, _ = release()
    gt = data["gt_joints"].astype(float)
    parts = procrustes_parts(data["pred_joints"].astype(float), gt)
    np.testing.assert_allclose(parts["procrustes_joints"], data["pa_aligned_joints"], atol=1e-6)
    np.testing.assert_allclose(parts["procrustes_R"], data["pa_R"], atol=1e-4)
    np.testing.assert_allclose(parts["procrustes_s"], data["pa_scale_s"], rtol=1e-5)
    np.testing.assert_allclose(parts["procrustes_s1"], data["pa_s1"], rtol=1e-6)
    np.testing.assert_allclose(parts["procrustes_det_R"], data["pa_det_R"], rtol=1e-6)
    errors = point_distances(parts["procrustes_joints"], gt).mean(-1)
    np.testing.assert_allclose(errors, data["pa_mpjpe_per_sample"], atol=1e-6)


def test_the_metrics_of_poem_v1() -> None:
    """The joints given on both sides; aligned in float32 there."""
    data = np.load(V1_GOLDEN)
    got = evaluate(*(data[key] for key in V1_POINTS), protocol="poem")
    for key, name in V1_METRICS.items():
        unit = 1000.0 if name.endswith("_mm") else 1.0
        np.testing.assert_allclose(got[name], unit * data[key], rtol=1e-6, err_msg=key)
