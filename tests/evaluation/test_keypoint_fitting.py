"""Key points from a file or of our detector, as the paper's optimisation is given them."""

import re
from dataclasses import replace

import numpy as np
import pytest

from poem_jax.data.right_hand import as_right_hand
from poem_jax.data.view_sampling import UniformViews
from poem_jax.evaluation import keypoint_fitting
from poem_jax.evaluation.dataset import SetSettings, score_set
from poem_jax.evaluation.keypoint_fitting import KeypointFitting, Solver, read_keypoints
from poem_jax.evaluation.robustness import shuffle_cameras
from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import transform_points
from poem_jax.hand.template import default_hand
from tests.data.one_frame import one_frame
from tests.mixture.fake_frames import FakeFrames

QUIET = SetSettings(batch_size=2, progress=False, cameras=UniformViews(2, 3))


class LeftFrames(FakeFrames):
    """The same photographs as of left hands: what is stored is the mirror image of what a frame gives."""

    def __getitem__(self, index):
        frame = super().__getitem__(index)
        left = one_frame(seed=index, views=self.views, side="left", key=frame.key)
        return as_right_hand(left._replace(images=frame.images))


@pytest.mark.parametrize("source", [FakeFrames(length=3), LeftFrames(length=3)])
def test_points_of_a_file_and_the_cameras_of_whole_images_fit_each_other(source, monkeypatch) -> None:
    stored = {}
    for index in range(3):
        frame = source[index]
        points = frame.keypoints_px.copy()
        if frame.mirror_px is not None:
            points[..., 0] = 2 * frame.mirror_px[:, None] - points[..., 0]
        stored[frame.key] = points
    stored.pop("take/000001")  # The file need not know every frame.
    asked = []

    def fit(model, seen, start, *, config, diagonal_px):
        assert start.quaternions.shape == (2, 16, 4)
        asked.append((seen, diagonal_px))
        size = len(seen.uv_px)
        return type(
            "Fit",
            (),
            {
                "joints": np.zeros((size, 21, 3)),
                "vertices": np.zeros((size, 778, 3)),
                "valid": np.ones(size, bool),
            },
        )

    monkeypatch.setattr(keypoint_fitting, "fit_take_adam", fit)
    found = []
    score_set(KeypointFitting(default_hand(), stored), source, QUIET, found.append)
    samples = [(one, row) for one, _ in asked for row in range(2)][:3]
    for index, (seen, row) in enumerate(samples):
        shown = np.isfinite(seen.uv_px[row]).all((-1, -2))
        assert shown.any() == (index != 1)
        if index == 1:
            continue
        # The world is the first chosen view's frame, and there the labels project to the key points.
        world = source[index].joints_cam[found[index].view]
        projected = project_cam(seen.K[row], transform_points(seen.T_cam_from_world[row], world[None]))
        np.testing.assert_allclose(projected[shown], seen.uv_px[row][shown], atol=0.05)
    assert {diagonal for _, diagonal in asked} == {400.0}


def stored_of(source):
    return {source[index].key: source[index].keypoints_px for index in range(len(source))}


@pytest.mark.parametrize("known", [False, True])
def test_a_file_that_knows_none_of_the_frames_is_told(known, monkeypatch) -> None:
    source = FakeFrames(length=2)
    stored = {f"other/{key}": points for key, points in stored_of(source).items()}
    if known:  # The last frame alone, which stands in the second batch.
        stored["take/000001"] = source[1].keypoints_px
    system = KeypointFitting(default_hand(), stored, solver=Solver.LEVENBERG_MARQUARDT)
    monkeypatch.setattr(keypoint_fitting, "fit_take", lambda model, seen, **_: unsolved(len(seen.uv_px)))
    assert system.unknown_keys is None
    score_set(system, source, replace(QUIET, batch_size=1))
    if known:
        assert system.unknown_keys is None
    else:
        assert re.search("such as 'take/000000'; .* such as 'other/take/000000'", str(system.unknown_keys))


def unsolved(size):
    class Fit:
        joints, vertices = np.zeros((size, 21, 3)), np.zeros((size, 778, 3))
        valid = np.zeros(size, bool)

    return Fit


def test_a_file_of_other_views_is_refused() -> None:
    source = FakeFrames(length=2)
    stored = {key: points[:-1] for key, points in stored_of(source).items()}
    with pytest.raises(ValueError, match=r"key points of take/000000 must be those of its \d views"):
        score_set(KeypointFitting(default_hand(), stored), source, QUIET)


def moved_a_little(batch, *, key):
    T = batch.cameras.T_cam_from_world.copy()
    T[:, 1, 0, 3] += 5e-4
    return batch._replace(cameras=batch.cameras._replace(T_cam_from_world=T))


def second_left_out(batch, *, key):
    mask = batch.cameras.view_mask.copy()
    mask[:, 1] = False
    return batch._replace(cameras=batch.cameras._replace(view_mask=mask))


@pytest.mark.parametrize("change", [shuffle_cameras, moved_a_little, second_left_out])
def test_key_points_of_a_file_do_not_go_with_changed_cameras(change) -> None:
    source = FakeFrames(length=2)
    system = KeypointFitting(default_hand(), stored_of(source))
    with pytest.raises(ValueError, match="as they were read; these were changed"):
        score_set(system, source, replace(QUIET, change=change))


def test_our_detector_looks_at_valid_crops_and_takes_the_surest_right_hand(monkeypatch) -> None:
    from poem_jax.detection.detector import DetectedHand

    looked = []

    def find(images):
        looked.extend(images)
        points = [np.full((21, 2), float(number), np.float32) for number in range(3)]
        hands = [
            DetectedHand(points[0], "left", 0.9, 0.99),
            DetectedHand(points[1], "right", 0.9, 0.6),
            DetectedHand(points[2], "right", 0.9, 0.8),
        ]
        return [hands if number else [] for number in range(len(images))]

    monkeypatch.setattr(keypoint_fitting, "find_hands", find)
    system = KeypointFitting(default_hand())
    batches = []
    monkeypatch.setattr(
        KeypointFitting, "__call__", lambda self, batch, seen: batches.append(batch) or known(batch)
    )
    score_set(system, FakeFrames(length=2), replace(QUIET, cameras=UniformViews(2, 2)))
    observed, diagonal_px = system._in_crops(batches[0])
    assert len(looked) == int(np.sum(batches[0].cameras.view_mask)) == 4
    assert looked[0].shape == (256, 256, 3)
    assert diagonal_px == pytest.approx(362.04, abs=0.01)
    first, others = observed.uv_px[0, 0], observed.uv_px[:, 1]
    assert np.isnan(first).all()
    np.testing.assert_array_equal(others[:, 0, 0], [2.0, 2.0])
    assert np.isnan(observed.uv_px[:, 2]).all()


def known(batch):
    from poem_jax.evaluation.systems import Answer

    return Answer(batch.joints_world, batch.vertices_world, np.ones(len(batch.views), bool))


def test_a_file_of_another_shape_is_refused(tmp_path) -> None:
    np.savez(tmp_path / "x.npz", keys=np.array(["a"]), keypoints_px=np.zeros((2, 3, 21, 2)))
    with pytest.raises(ValueError, match=r"\(sample, view, 21, 2\), with as many `keys"):
        read_keypoints(tmp_path / "x.npz")
    np.savez(tmp_path / "y.npz", keys=np.array(["a"]), keypoints_px=np.zeros((1, 3, 21, 2)))
    assert read_keypoints(tmp_path / "y.npz")["a"].shape == (3, 21, 2)
