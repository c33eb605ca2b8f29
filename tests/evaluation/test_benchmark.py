"""The benchmark on captures and predictors made up here, whose errors are known."""

import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.data.augmentation_recipes import NONE
from poem_jax.evaluation.benchmark import (
    BenchmarkSettings,
    Reconstructions,
    Scores,
    nested_views,
    run_benchmark,
)
from poem_jax.evaluation.metrics import evaluate
from poem_jax.evaluation.systems import Answer
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES, NUM_VERTICES, ROOT_JOINT

HW = (32, 32)


class MadeUpCaptures:
    """Random points seen by cameras on a sphere; no images."""

    def sample(self, index: int, num_views: int | None = None) -> MultiViewBatch:
        rng = np.random.default_rng((7, index))
        pose = rng.normal(0, 1, (16, 3)).astype(np.float32)
        hand = rng.normal(0, 0.04, (NUM_QUERIES, 3)) @ rotation_from_axis_angle(pose[0].astype(float)).T
        points = (hand + rng.normal(0, 0.3, 3)).astype(np.float32)
        joints, vertices = points[:NUM_JOINTS], points[NUM_JOINTS:]
        cameras = self._cameras(rng, joints[ROOT_JOINT])
        keypoints, _ = project(
            cameras.K, cameras.T_cam_from_world, np.broadcast_to(joints, (8, NUM_JOINTS, 3))
        )
        whole = MultiViewBatch(np.zeros((8, *HW, 3), np.uint8), cameras, joints, vertices, keypoints, pose)
        return self._first_views(whole, num_views or 8)

    def _cameras(self, rng: np.random.Generator, target: np.ndarray) -> Cameras:
        R = rotation_from_axis_angle(rng.normal(0, 2, (8, 3)))
        T = rigid(R, np.array([0, 0, 0.6]) - np.einsum("vij,j->vi", R, target)).astype(np.float32)
        K = np.array([[60, 0, 16], [0, 60, 16], [0, 0, 1]], np.float32)
        return Cameras(np.broadcast_to(K, (8, 3, 3)), T)

    def _first_views(self, sample: MultiViewBatch, n: int) -> MultiViewBatch:
        cameras = Cameras(*(leaf[:n] for leaf in sample.cameras))
        return sample._replace(views=sample.views[:n], cameras=cameras, keypoints_px=sample.keypoints_px[:n])


def predict_shifted(batch: MultiViewBatch) -> Reconstructions:
    """Off by (12 / views) mm along x, and exact when the root is given."""
    num_views = batch.views.shape[1]
    shift = np.array([0.012 / num_views, 0, 0], np.float32)
    return Reconstructions(_prediction(batch, shift), _prediction(batch, 0 * shift))


def _prediction(batch: MultiViewBatch, shift: np.ndarray) -> Prediction:
    vertices, joints = batch.vertices_world + shift, batch.joints_world + shift
    size, views = batch.views.shape[:2]
    return Prediction(
        vertices_world=vertices,
        joints_world=joints,
        root_world=joints[:, ROOT_JOINT],
        keypoints_px=np.zeros((size, views, 1, 2), np.float32),
        layers_world=np.concatenate([vertices, joints], 1)[:, None],
        valid=np.arange(size) % 2 == 0,
    )


def run(**settings) -> dict[int, Scores]:
    return run_benchmark(predict_shifted, MadeUpCaptures(), BenchmarkSettings(progress=False, **settings))


@pytest.fixture(scope="module")
def results() -> dict[int, Scores]:
    return run(views=(2, 4), samples=6, batch_size=3)


def test_errors_of_a_known_shift(results: dict[int, Scores]) -> None:
    for n, scores in results.items():
        for name in ("mpvpe_mm", "median_mpvpe_mm", "mpjpe_mm", "root_error_mm"):
            np.testing.assert_allclose(scores[name], 12 / n, rtol=1e-3, err_msg=name)
        for name in ("rr_mpvpe_mm", "pa_mpjpe_mm", "mpvpe_true_root_mm", "median_mpvpe_true_root_mm"):
            np.testing.assert_allclose(scores[name], 0, atol=1e-3, err_msg=name)


def test_a_padded_last_batch_changes_nothing(results: dict[int, Scores]) -> None:
    padded = run(views=(2, 4), samples=6, batch_size=4)
    for n, scores in results.items():
        assert padded[n]["samples"] == scores["samples"] == 6
        without = {name for name, value in scores.items() if value is None}
        assert without == {"fit_mpvpe_mm", "median_fit_mpvpe_mm", "fit_unsolved"}
        for name in scores.keys() - {"unsolved", "dlt_2px_root_error_mm"} - without:
            np.testing.assert_allclose(padded[n][name], scores[name], rtol=1e-6, err_msg=name)
        # Triangulation runs in float32 and batches of another size round differently.
        name = "dlt_2px_root_error_mm"
        np.testing.assert_allclose(padded[n][name], scores[name], rtol=1e-3)


def test_the_metrics_are_those_of_evaluate(results: dict[int, Scores]) -> None:
    samples = [MadeUpCaptures().sample(i, num_views=4) for i in range(6)]
    joints, vertices = (np.stack([getattr(s, f"{k}_world") for s in samples]) for k in ("joints", "vertices"))
    shift = np.array([0.003, 0, 0], np.float32)
    expected = evaluate(joints + shift, joints, vertices + shift, vertices, protocol="poem")
    for name, value in expected.items():
        np.testing.assert_allclose(results[4][name], value, rtol=1e-6, err_msg=name)


def test_the_fit_stands_beside_where_views_suffice_for_it() -> None:
    class Fit:
        hand, image_hw, recipe = default_hand(), HW, NONE
        least_views, most_views, takes_root, one_at_a_time = 4, None, False, False

        def __call__(self, batch, seen):
            shift = np.array([0.005, 0, 0], np.float32)
            valid = np.arange(len(batch.views)) > 0
            return Answer(batch.joints_world, batch.vertices_world + shift, valid)

    settings = BenchmarkSettings(views=(2, 4), samples=5, batch_size=3, progress=False)
    scores = run_benchmark(predict_shifted, MadeUpCaptures(), settings, fitting=Fit())
    for name in ("fit_mpvpe_mm", "median_fit_mpvpe_mm"):
        assert scores[2][name] is None
        np.testing.assert_allclose(scores[4][name], 5, rtol=1e-3)
    # The first sample of each batch.
    assert (scores[2]["fit_unsolved"], scores[4]["fit_unsolved"]) == (None, 2)


def test_unsolved_samples_are_counted(results: dict[int, Scores]) -> None:
    # Samples 0 and 2 of each batch of three are solved.
    assert [scores["unsolved"] for scores in results.values()] == [2, 2]


def test_more_views_triangulate_better(results: dict[int, Scores]) -> None:
    assert 0 < results[4]["dlt_2px_root_error_mm"] < results[2]["dlt_2px_root_error_mm"]


def test_one_view_has_no_triangulated_root() -> None:
    scores = run(views=(1,), samples=2, batch_size=2)[1]
    assert scores["dlt_2px_root_error_mm"] is None


def test_baselines_do_not_depend_on_the_views(results: dict[int, Scores]) -> None:
    for name in ("mean_pose_mpvpe_mm", "mean_pose_rotated_mpvpe_mm"):
        assert results[2][name] == results[4][name] > 0


def test_nested_views_are_the_first() -> None:
    batch = MultiViewBatch(
        views=np.arange(8).reshape(1, 8, 1, 1, 1) * np.ones((1, 8, 2, 2, 3)),
        cameras=Cameras(np.ones((1, 8, 3, 3)), np.ones((1, 8, 4, 4))),
        joints_world=np.zeros((1, NUM_JOINTS, 3)),
        vertices_world=np.zeros((1, NUM_VERTICES, 3)),
        keypoints_px=np.zeros((1, 8, NUM_JOINTS, 2)),
    )
    part = nested_views(batch, 3)
    assert part.views[0, :, 0, 0, 0].tolist() == [0, 1, 2]
    assert [leaf.shape[1] for leaf in (*part.cameras, part.keypoints_px)] == [3, 3, 3, 3]


def test_other_protocols_may_be_asked_for() -> None:
    scores = run(views=(2,), samples=2, batch_size=2, protocol="ho3d")[2]
    assert "sc_tr_mpjpe_mm" in scores


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"views": (0, 2)}, "counts from 1 to 8"),
        ({"views": (9,)}, "counts from 1 to 8"),
        ({"views": ()}, "counts from 1 to 8"),
        ({"views": (2, 2)}, "each count once"),
        ({"samples": 0}, "`samples` and `batch_size` must be at least 1"),
        ({"protocol": "nyu"}, "`protocol` must be one of"),
    ],
)
def test_settings_are_checked(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BenchmarkSettings(**settings)
