"""Errors of predicted hands against ground truth, per point and as the official numbers (NumPy float64).

Distances are arrays (sample, point) in the protocol's unit. The official averages are over samples per point
and then over points; no point is ever invisible here, so that equals the plain mean.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from poem_jax.evaluation.alignment import align, align_by_joints, scale_translation, subtract_wrist
from poem_jax.evaluation.protocols import AUC_LIMITS_MM, F_THRESHOLDS_MM, NO_SCORE, Protocol, find_protocol
from poem_jax.hand.model import HandModel, joints_from_vertices
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.typing import Array, Float, Num

_TREE_SAMPLES = 128


class Hands(NamedTuple):
    """Joints and vertices of n hands, float64, in the protocol's unit."""

    joints: Float[np.ndarray, "sample joint 3"]
    vertices: Float[np.ndarray, "sample vert 3"]


class FScores(NamedTuple):
    """F score and its parts, per sample and threshold."""

    f: Float[np.ndarray, "sample threshold"]
    precision: Float[np.ndarray, "sample threshold"]
    """Share of predicted points near the ground truth (the official code calls it recall)."""
    recall: Float[np.ndarray, "sample threshold"]
    """Share of ground-truth points near the prediction (the official code calls it precision)."""


def evaluate(
    pred_joints: Num[Array, "..."],
    gt_joints: Num[Array, "..."],
    pred_vertices: Num[Array, "..."],
    gt_vertices: Num[Array, "..."],
    *,
    protocol: str,
    hand: HandModel | None = None,
) -> dict[str, float]:
    """Score predicted hands as an official evaluator does.

    Every protocol gives the errors `mpjpe_mm`, `mpvpe_mm` and the areas `auc_j_20`, `auc_v_20`, `auc_j_50`,
    `auc_v_50`, each also root-relative (`rr_`, minus joint 0) and Procrustes-aligned (`pa_`), by its own
    number of thresholds and unit; `poem`, `freihand` and `ho3d` add `f_5`, `f_15`, `pa_f_5`, `pa_f_15`;
    `ho3d` adds `sc_tr_mpjpe_mm`, `sc_tr_auc_j_50`. For `freihand` and `ho3d` a mesh of another vertex count
    than the ground truth scores -1 in every vertex error, and its aligned F scores use the joints' alignment.
    `poem-release` has the metrics of `poem`, of joints regressed from the meshes of both sides (so `rr_` is
    about the wrist of the own mesh); only `auc_j_20` and `auc_j_50` are of the joints given.
    Args:
        pred_joints: (n, 21, 3) metres, any frame, joint 0 the wrist (`sc_tr_` also reads joint 4 as given).
        gt_joints: (n, 21, 3) metres, the same frame and order.
        pred_vertices: (n, 778, 3) metres.
        gt_vertices: (n, 778, 3) metres.
        protocol: 'poem', 'poem-release', 'freihand', 'ho3d' or 'dexycb'.
        hand: whose regressor `poem-release` uses; the others need none.
    Returns: the metrics, in millimetres where the name says so, else shares in [0, 1].
    Raises:
        ValueError: unknown protocol, wrong or mismatched shape, no sample, or a number that is not finite.
    """
    rules = find_protocol(protocol)
    points = {
        "pred_joints": pred_joints,
        "gt_joints": gt_joints,
        "pred_vertices": pred_vertices,
        "gt_vertices": gt_vertices,
    }
    points = {name: _checked(name, value) * rules.units_per_metre for name, value in points.items()}
    _check_shapes(points, rules)
    pred = Hands(points["pred_joints"], points["pred_vertices"])
    gt = Hands(points["gt_joints"], points["gt_vertices"])
    if not rules.regresses_joints:
        return _scores(pred, gt, rules)
    if hand is None:
        raise ValueError(f"protocol {protocol!r} regresses joints from vertices: give `hand`; got None")
    direct = _set_scores(pred.joints, gt.joints, rules, "", "mpjpe_mm", "j")
    areas = {name: value for name, value in direct.items() if name.startswith("auc")}
    return _scores(_regressed(pred, hand), _regressed(gt, hand), rules) | areas


def evaluate_joints(
    pred_joints: Num[Array, "..."], gt_joints: Num[Array, "..."], *, protocol: str
) -> dict[str, float]:
    """Return those metrics of `evaluate` that are of the joints given, for labels without a mesh.

    `poem-release`, which regresses its joints from meshes, has none of these but the areas: it is refused.
    Args and errors as for `evaluate`.
    """
    rules = find_protocol(protocol)
    if rules.regresses_joints:
        raise ValueError(f"protocol {protocol!r} regresses joints from labelled vertices, and there are none")
    points = {"pred_joints": pred_joints, "gt_joints": gt_joints}
    points = {name: _checked(name, value) * rules.units_per_metre for name, value in points.items()}
    pred, gt = points["pred_joints"], points["gt_joints"]
    for name, value in points.items():
        _expect(name, value.shape, (len(gt), NUM_JOINTS, 3))
    relative = subtract_wrist(pred, pred), subtract_wrist(gt, gt)
    scores: dict[str, float] = {}
    for prefix, pair in {"": (pred, gt), "rr_": relative, "pa_": (align(pred, gt), gt)}.items():
        scores |= _set_scores(*pair, rules, prefix, "mpjpe_mm", "j")
    return scores


def point_distances(
    pred: Float[np.ndarray, "sample point 3"], gt: Float[np.ndarray, "sample point 3"]
) -> Float[np.ndarray, "sample point"]:
    """Return the Euclidean distance of each point to its ground truth, in the unit of the input."""
    return np.linalg.norm(pred - gt, axis=-1)


def mean_error(distances: Float[np.ndarray, "sample point"]) -> float:
    """Average over samples per point, then over points."""
    return float(distances.mean(0).mean())


def median_error(distances: Float[np.ndarray, "sample point"]) -> float:
    """Take the median over samples per point, then average over points (FreiHAND's `EvalUtil`)."""
    return float(np.median(distances, axis=0).mean())


def pck_curve(
    distances: Float[np.ndarray, "sample point"], thresholds: Float[np.ndarray, " step"]
) -> Float[np.ndarray, "step point"]:
    """Return per threshold and point the share of samples with distance <= threshold."""
    return np.stack([(distances <= threshold).mean(0) for threshold in thresholds])


def area_under_curve(
    distances: Float[np.ndarray, "sample point"], thresholds: Float[np.ndarray, " step"]
) -> Float[np.ndarray, " point"]:
    """Integrate each point's PCK curve by trapezoids and divide by the range of the thresholds."""
    curve = pck_curve(distances, thresholds)
    # The range is summed exactly as the area is, so that a perfect prediction scores exactly 1.
    return np.trapezoid(curve, thresholds, axis=0) / np.trapezoid(np.ones_like(curve), thresholds, axis=0)


def f_scores(
    pred: Float[np.ndarray, "sample point 3"],
    gt: Float[np.ndarray, "sample other 3"],
    thresholds: Float[np.ndarray, " threshold"],
) -> FScores:
    """Compare point sets without correspondence: F = 2PR / (P + R), 0 where both are 0.

    A point counts when its nearest neighbour in the other set is strictly nearer than the threshold
    (Knapitsch et al., Tanks and Temples, 2017, as FreiHAND and HO-3D compute it).
    """
    limit = float(thresholds.max())
    precision = _share_below(_nearest_distances(pred, gt, limit), thresholds)
    recall = _share_below(_nearest_distances(gt, pred, limit), thresholds)
    total = precision + recall
    f = np.where(total > 0, 2 * precision * recall / np.where(total > 0, total, 1.0), 0.0)
    return FScores(f, precision, recall)


def _scores(pred: Hands, gt: Hands, rules: Protocol) -> dict[str, float]:
    corresponds = pred.vertices.shape == gt.vertices.shape
    if corresponds:
        aligned_vertices = align(pred.vertices, gt.vertices)
    else:
        aligned_vertices = align_by_joints(pred.vertices, pred.joints, gt.joints)
    pairs = {
        "": (pred, gt),
        "rr_": (_root_relative(pred), _root_relative(gt)),
        "pa_": (Hands(align(pred.joints, gt.joints), aligned_vertices), gt),
    }
    scores: dict[str, float] = {}
    for prefix, (moved, target) in pairs.items():
        scores |= _set_scores(moved.joints, target.joints, rules, prefix, "mpjpe_mm", "j")
        if corresponds:
            scores |= _set_scores(moved.vertices, target.vertices, rules, prefix, "mpvpe_mm", "v")
        else:
            scores |= _no_vertex_scores(prefix)
    if rules.has_f_scores:
        scores |= _f_score_means(pred.vertices, gt.vertices, rules, "")
        scores |= _f_score_means(aligned_vertices, gt.vertices, rules, "pa_")
    if rules.has_scale_translation:
        scores |= _scale_translation_scores(pred, gt, rules)
    return scores


def _regressed(hands: Hands, hand: HandModel) -> Hands:
    """Replace the joints by those that the mesh implies."""
    double = hand._replace(J_regressor=np.asarray(hand.J_regressor, np.float64))
    return hands._replace(joints=joints_from_vertices(double, hands.vertices))


def _set_scores(
    pred: np.ndarray, gt: np.ndarray, rules: Protocol, prefix: str, error_name: str, letter: str
) -> dict[str, float]:
    distances = point_distances(pred, gt)
    scores = {prefix + error_name: mean_error(distances) * rules.mm_per_unit}
    for limit_mm in AUC_LIMITS_MM:
        areas = area_under_curve(distances, rules.auc_thresholds(limit_mm))
        scores[f"{prefix}auc_{letter}_{limit_mm}"] = float(areas.mean())
    return scores


def _no_vertex_scores(prefix: str) -> dict[str, float]:
    names = ["mpvpe_mm", *(f"auc_v_{limit_mm}" for limit_mm in AUC_LIMITS_MM)]
    return {prefix + name: NO_SCORE for name in names}


def _f_score_means(pred: np.ndarray, gt: np.ndarray, rules: Protocol, prefix: str) -> dict[str, float]:
    thresholds = np.asarray(F_THRESHOLDS_MM) / rules.mm_per_unit
    means = f_scores(pred, gt, thresholds).f.mean(0)
    return {
        f"{prefix}f_{threshold_mm}": float(mean)
        for threshold_mm, mean in zip(F_THRESHOLDS_MM, means, strict=True)
    }


def _scale_translation_scores(pred: Hands, gt: Hands, rules: Protocol) -> dict[str, float]:
    moved = scale_translation(pred.joints, gt.joints)
    scores = _set_scores(moved, gt.joints, rules, "sc_tr_", "mpjpe_mm", "j")
    return {name: scores[name] for name in ("sc_tr_mpjpe_mm", "sc_tr_auc_j_50")}


def _root_relative(hands: Hands) -> Hands:
    return Hands(subtract_wrist(hands.joints, hands.joints), subtract_wrist(hands.vertices, hands.joints))


def _nearest_distances(queries: np.ndarray, points: np.ndarray, limit: float) -> np.ndarray:
    """Distance of each query to the nearest point of its own sample; infinite beyond `limit`."""
    starts = range(0, len(queries), _TREE_SAMPLES)
    return np.concatenate(
        [
            _nearest_in_tree(queries[i : i + _TREE_SAMPLES], points[i : i + _TREE_SAMPLES], limit)
            for i in starts
        ]
    )


def _nearest_in_tree(queries: np.ndarray, points: np.ndarray, limit: float) -> np.ndarray:
    # One tree for many samples: a fourth coordinate keeps them further apart than the limit, and is exactly 0
    # in differences within a sample. The bound saves the search where hands are far from each other.
    separation = 10.0 * limit
    tree = KDTree(_with_sample_coordinate(points, separation))
    query_rows = _with_sample_coordinate(queries, separation)
    distances, _ = tree.query(query_rows, distance_upper_bound=2.0 * limit)
    return np.asarray(distances).reshape(queries.shape[:2])


def _with_sample_coordinate(points: np.ndarray, separation: float) -> np.ndarray:
    sample = np.broadcast_to(np.arange(len(points))[:, None, None] * separation, (*points.shape[:2], 1))
    return np.concatenate([points, sample], axis=-1).reshape(-1, 4)


def _share_below(distances: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    return (distances[:, None] < thresholds[:, None]).mean(-1)


def _checked(name: str, value: Array) -> np.ndarray:
    points = np.asarray(value, dtype=np.float64)
    if points.ndim != 3 or points.shape[-1] != 3 or 0 in points.shape:
        raise ValueError(
            f"`{name}` must have shape (sample, point, 3) with at least one of each; got {points.shape}"
        )
    bad = np.logical_not(np.isfinite(points)).any(axis=(1, 2))
    if bad.any():
        raise ValueError(
            f"`{name}` must be finite; got NaN or infinity in {bad.sum()} of {bad.size} samples, first at "
            f"index {int(bad.argmax())}: leave such samples out, or fill them and count them as failures"
        )
    return points


def _check_shapes(points: dict[str, np.ndarray], rules: Protocol) -> None:
    num_samples = len(points["gt_joints"])
    for name in ("pred_joints", "gt_joints"):
        _expect(name, points[name].shape, (num_samples, NUM_JOINTS, 3))
    gt_vertices = points["gt_vertices"].shape
    _expect("gt_vertices", gt_vertices, (num_samples, *gt_vertices[1:]))
    num_vertices = points["pred_vertices"].shape[1] if rules.accepts_other_meshes else gt_vertices[1]
    _expect("pred_vertices", points["pred_vertices"].shape, (num_samples, num_vertices, 3))


def _expect(name: str, got: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if got != expected:
        raise ValueError(f"`{name}` must have shape (sample, point, 3) = {expected}; got {got}")
