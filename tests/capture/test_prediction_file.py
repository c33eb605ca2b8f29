"""`prediction.npz`: what it holds at any time, also of worlds far from their origin."""

import contextlib

import numpy as np
import pytest

from poem_jax.capture import prediction_file
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.prediction_file import PredictionFile
from poem_jax.capture.take import Take

NEAR = np.zeros(3)


@pytest.fixture
def open_file(rig, tmp_path):
    """`open_file(origin)`: a file of two hands, closed after the test."""
    with contextlib.ExitStack() as stack:
        take = Take(rig, ("right", "left"), [])

        def start(origin=NEAR):
            file = PredictionFile(tmp_path / "prediction.npz", take, origin)
            return stack.enter_context(contextlib.closing(file))

        yield start


def found(value, **more):
    points = {"vertices_world": (778, 3), "joints_world": (21, 3), "root_world": (3,)}
    arrays = {name: np.full(shape, value, np.float32) for name, shape in points.items()}
    return HandResult(np.ones(3, bool), reprojection_px=np.array([1.0, np.nan, value]), **arrays, **more)


def frame(name, *hands):
    return Frame(name, np.full((2, 3, 4), np.nan), hands=hands)


LOST = HandResult(np.array([True, False, False]), "seen in 1 view(s); two are needed")


def read(path):
    with np.load(path) as stored:
        return dict(stored)


def test_frames_follow_each_other_and_what_is_lost_is_nan(open_file, tmp_path):
    file = open_file()
    file.add(frame("a", found(1.0), LOST))
    file.add(frame("bcd", LOST, found(2.0, shape=np.arange(10.0))))
    file.write()
    arrays = read(tmp_path / "prediction.npz")
    assert arrays["frames"].tolist() == ["a", "bcd"]
    assert arrays["hand_side"].tolist() == ["right", "left"]
    assert arrays["cameras"].tolist() == ["left_cam", "front", "cam 3"]
    assert arrays["valid"].tolist() == [[True, False], [False, True]]
    assert arrays["views_used"][0].tolist() == [[True, True, True], [True, False, False]]
    assert (arrays["vertices_world"][0, 0] == 1).all()
    assert np.isnan(arrays["vertices_world"][0, 1]).all()
    np.testing.assert_array_equal(arrays["reprojection_px"][1, 1], [1, np.nan, 2])
    np.testing.assert_array_equal(arrays["shape"][1, 1], np.arange(10))
    assert np.isnan(arrays["shape"][0]).all()
    assert not {"pose", "translation", "joint_sigma_m"} & set(arrays), "no hand gave these"
    assert arrays["joints_world"].dtype == np.float32


def test_the_file_can_be_read_while_it_grows(open_file, tmp_path, monkeypatch):
    monkeypatch.setattr(prediction_file, "FLUSH_SECONDS", 0.0)
    monkeypatch.setattr(prediction_file, "_MAX_SHARE", 1e9)
    file = open_file()
    file.add(frame("0", LOST, LOST))
    assert not (tmp_path / "prediction.npz").exists(), "nothing was found so far"
    for count in (2, 3, 4):
        file.add(frame(str(count), found(float(count)), LOST))
        arrays = read(tmp_path / "prediction.npz")
        assert len(arrays["frames"]) == count
        assert arrays["joints_world"].shape == (count, 2, 21, 3)
        assert (arrays["joints_world"][-1, 0] == count).all()
    file.close()
    assert [path.name for path in tmp_path.iterdir()] == ["prediction.npz"]


def test_a_far_world_keeps_its_millimetres(open_file, tmp_path):
    """500 km from the origin float32 would round by 3 cm."""
    origin = np.array([500e3, 4500e3, 300.0])
    file = open_file(origin)
    place = np.array([0.001, 0.002, 0.003])
    file.add(frame("0", found(0.001, translation=place), LOST))
    file.write()
    arrays = read(tmp_path / "prediction.npz")
    np.testing.assert_allclose(arrays["joints_world"][0, 0] - origin, 0.001, atol=1e-6)
    np.testing.assert_allclose(arrays["translation"][0, 0] - origin, place, atol=1e-6)
