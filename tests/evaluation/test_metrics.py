"""Laws of the metrics, and what they refuse."""

import numpy as np
import pytest

from poem_jax.evaluation.alignment import align, align_by_joints, fit_similarity, scale_translation
from poem_jax.evaluation.metrics import area_under_curve, evaluate, f_scores, pck_curve
from poem_jax.evaluation.protocols import PROTOCOLS, find_protocol
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_JOINTS, NUM_VERTICES, WRIST

NUM_SAMPLES = 6
ALWAYS = {
    f"{prefix}{name}"
    for prefix in ("", "rr_", "pa_")
    for name in ("mpjpe_mm", "mpvpe_mm", "auc_j_20", "auc_v_20", "auc_j_50", "auc_v_50")
}
F_NAMES = {"f_5", "f_15", "pa_f_5", "pa_f_15"}
SCALE_NAMES = {"sc_tr_mpjpe_mm", "sc_tr_auc_j_50"}


def hands(seed: int, noise_m: float = 0.01) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    centre = np.array([0, 0, 0.6])
    joints = centre + rng.normal(0, 0.05, (NUM_SAMPLES, NUM_JOINTS, 3))
    vertices = centre + rng.normal(0, 0.05, (NUM_SAMPLES, NUM_VERTICES, 3))
    return {
        "pred_joints": joints + rng.normal(0, noise_m, joints.shape),
        "gt_joints": joints,
        "pred_vertices": vertices + rng.normal(0, noise_m, vertices.shape),
        "gt_vertices": vertices,
    }


def similarity(seed: int) -> tuple[float, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.7, 1.4), np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)


@pytest.mark.parametrize(
    ("protocol", "expected"),
    [
        ("poem", ALWAYS | F_NAMES),
        ("freihand", ALWAYS | F_NAMES),
        ("ho3d", ALWAYS | F_NAMES | SCALE_NAMES),
        ("dexycb", ALWAYS),
    ],
)
def test_names_of_the_metrics(protocol: str, expected: set[str]) -> None:
    got = evaluate(**hands(0), protocol=protocol)
    assert set(got) == expected
    assert all(type(value) is float for value in got.values())


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_perfect_prediction(protocol: str) -> None:
    got = evaluate(**hands(0, noise_m=0.0), protocol=protocol, hand=default_hand())
    for name, value in got.items():
        if name.endswith("_mm"):
            assert value < 1e-5, name
        elif "pa_auc" in name or "sc_tr_auc" in name:
            # Alignment leaves rounding errors, which the threshold 0 does not forgive.
            assert value > 0.97, name
        else:
            assert value == 1.0, name


def test_procrustes_errors_do_not_see_a_similarity() -> None:
    points = hands(1)
    before = evaluate(**points, protocol="poem")
    scale, rotation, shift = similarity(2)
    for name in ("pred_joints", "pred_vertices"):
        points[name] = scale * points[name] @ rotation.T + shift
    after = evaluate(**points, protocol="poem")
    for name in ("pa_mpjpe_mm", "pa_mpvpe_mm", "pa_auc_j_20", "pa_f_5"):
        np.testing.assert_allclose(after[name], before[name], rtol=1e-5)
    assert after["mpjpe_mm"] > 10 * before["mpjpe_mm"]


def test_root_relative_errors_do_not_see_a_shift() -> None:
    points = hands(1)
    before = evaluate(**points, protocol="dexycb")
    for name in ("pred_joints", "pred_vertices"):
        points[name] = points[name] + [0.3, -0.2, 0.1]
    after = evaluate(**points, protocol="dexycb")
    np.testing.assert_allclose(after["rr_mpjpe_mm"], before["rr_mpjpe_mm"], rtol=1e-9)
    np.testing.assert_allclose(after["rr_mpvpe_mm"], before["rr_mpvpe_mm"], rtol=1e-9)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_errors_move_with_the_frame_of_both_hands(protocol: str) -> None:
    points = hands(3)
    _, rotation, shift = similarity(4)
    before = evaluate(**points, protocol=protocol, hand=default_hand())
    after = evaluate(
        **{k: v @ rotation.T + shift for k, v in points.items()}, protocol=protocol, hand=default_hand()
    )
    np.testing.assert_allclose([*after.values()], [*before.values()], rtol=1e-6)


def test_samples_may_come_in_any_order() -> None:
    points = hands(5)
    before = evaluate(**points, protocol="ho3d")
    after = evaluate(**{k: v[::-1] for k, v in points.items()}, protocol="ho3d")
    np.testing.assert_allclose([*after.values()], [*before.values()], rtol=1e-12)


def test_f_scores_equal_brute_force() -> None:
    rng = np.random.default_rng(0)
    gt, pred = rng.normal(0, 0.02, (130, 30, 3)), rng.normal(0, 0.02, (130, 41, 3))
    pred[0] += 5.0
    thresholds = np.array([0.005, 0.015])
    got = f_scores(pred, gt, thresholds)
    distances = np.linalg.norm(pred[:, :, None] - gt[:, None], axis=-1)
    precision = (distances.min(2)[:, None] < thresholds[:, None]).mean(-1)
    recall = (distances.min(1)[:, None] < thresholds[:, None]).mean(-1)
    with np.errstate(invalid="ignore"):
        f = np.nan_to_num(2 * precision * recall / (precision + recall))
    np.testing.assert_array_equal(got.precision, precision)
    np.testing.assert_array_equal(got.recall, recall)
    np.testing.assert_allclose(got.f, f, rtol=1e-12)
    assert (got.f[0] == 0).all()


def test_f_score_needs_strictly_less_and_pck_does_not() -> None:
    gt, pred = np.zeros((1, 1, 3)), np.array([[[0.25, 0.0, 0.0]]])
    assert f_scores(pred, gt, np.array([0.25])).f == 0.0
    assert pck_curve(np.array([[0.25]]), np.array([0.25])) == 1.0


def test_area_of_a_step() -> None:
    # All errors at half the range: the curve is 0 then 1, so the area is one half.
    thresholds = np.linspace(0, 1, 101)
    np.testing.assert_allclose(area_under_curve(np.full((4, 3), 0.505), thresholds), 0.495)


def test_procrustes_allows_a_reflection_and_a_collapsed_hand() -> None:
    gt = hands(6)["gt_joints"]
    mirrored = gt * [-1, 1, 1]
    np.testing.assert_allclose(align(mirrored, gt), gt, atol=1e-7)
    np.testing.assert_allclose(np.linalg.det(fit_similarity(mirrored, gt).R), -1)
    collapsed = align(np.zeros_like(gt), gt)
    np.testing.assert_allclose(collapsed, np.broadcast_to(gt.mean(1, keepdims=True), gt.shape))


def test_scale_translation_fixes_one_length_and_the_wrist() -> None:
    points = hands(7)
    got = scale_translation(points["pred_joints"], points["gt_joints"])
    np.testing.assert_allclose(got[:, WRIST], points["gt_joints"][:, WRIST])
    lengths = [
        np.linalg.norm(joints[:, 4] - joints[:, WRIST], axis=-1) for joints in (got, points["gt_joints"])
    ]
    np.testing.assert_allclose(*lengths)
    assert np.isfinite(scale_translation(np.zeros_like(got), points["gt_joints"])).all()


@pytest.mark.parametrize("protocol", ["freihand", "ho3d"])
def test_another_mesh_scores_minus_one_and_is_moved_by_the_joints(protocol: str) -> None:
    points = hands(8)
    whole = evaluate(**points, protocol=protocol, hand=default_hand())
    part = evaluate(**points | {"pred_vertices": points["pred_vertices"][:, :500]}, protocol=protocol)
    for name, value in part.items():
        if "mpvpe" in name or "auc_v" in name:
            assert value == -1.0, name
        elif "f_" not in name:
            assert value == whole[name], name
    assert 0 < part["f_15"] < whole["f_15"]


def test_another_mesh_turns_about_its_own_mean() -> None:
    points = hands(9, noise_m=0.0)
    joints = points["gt_joints"]
    moved = align_by_joints(points["gt_vertices"] + 1.0, joints + 1.0, joints)
    mean = points["gt_vertices"].mean(1)
    np.testing.assert_allclose(moved.mean(1), mean, atol=1e-9)
    # The official code leaves out the division by the prediction's norm.
    norm = np.linalg.norm(joints - joints.mean(1, keepdims=True), axis=(1, 2))
    shrunk = (points["gt_vertices"] - mean[:, None]) * norm[:, None, None]
    np.testing.assert_allclose(moved - mean[:, None], shrunk, atol=1e-7)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_lower_precision_is_raised_to_float64(dtype: type) -> None:
    points = hands(10)
    got = evaluate(**{k: v.astype(dtype) for k, v in points.items()}, protocol="poem")
    np.testing.assert_allclose(got["mpjpe_mm"], evaluate(**points, protocol="poem")["mpjpe_mm"], rtol=1e-5)


class TestRefusals:
    def test_unknown_protocol(self) -> None:
        with pytest.raises(
            ValueError, match=r"one of 'poem', 'poem-release', 'freihand', 'ho3d', 'dexycb'; got 'frei'"
        ):
            evaluate(**hands(0), protocol="frei")

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_not_finite(self, bad: float) -> None:
        points = hands(0)
        points["pred_vertices"][[2, 4], 7, 1] = bad
        with pytest.raises(
            ValueError, match=r"`pred_vertices` must be finite.*2 of 6 samples, first at index 2"
        ):
            evaluate(**points, protocol="poem")

    @pytest.mark.parametrize(
        ("name", "part", "message"),
        [
            (
                "pred_joints",
                np.s_[:, :20],
                r"`pred_joints` must have .* = \(6, 21, 3\); got \(6, 20, 3\)",
            ),
            ("gt_joints", np.s_[:, :, :2], r"`gt_joints` must have shape .*; got \(6, 21, 2\)"),
            ("pred_joints", np.s_[:5], r"`pred_joints` must have .* = \(6, 21, 3\); got \(5, 21, 3\)"),
            (
                "gt_vertices",
                np.s_[:5],
                r"`gt_vertices` must have .* = \(6, 778, 3\); got \(5, 778, 3\)",
            ),
            ("pred_vertices", np.s_[:, :9], r"`pred_vertices` must have .* = \(6, 778, 3\); got \(6, 9, 3\)"),
            ("pred_vertices", np.s_[0], r"`pred_vertices` must have shape .*; got \(778, 3\)"),
        ],
    )
    def test_shapes(self, name: str, part: tuple, message: str) -> None:
        points = hands(0)
        with pytest.raises(ValueError, match=message):
            evaluate(**points | {name: points[name][part]}, protocol="poem")

    def test_no_sample(self) -> None:
        with pytest.raises(ValueError, match="at least one of each"):
            evaluate(**{k: v[:0] for k, v in hands(0).items()}, protocol="poem")


def test_thresholds_include_both_ends() -> None:
    thresholds = find_protocol("poem").auc_thresholds(20)
    assert (len(thresholds), thresholds[0], thresholds[-1]) == (20, 0.0, 0.02)
    assert find_protocol("dexycb").auc_thresholds(50)[-1] == 50.0
