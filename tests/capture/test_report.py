"""`report.json`: what it says of frames and of the whole take, and the seconds of each stage."""

import contextlib
import json
import time

import numpy as np
import pytest

from poem_jax.capture.frame import Frame, HandResult, ImageProblem
from poem_jax.capture.report import Clock, Report
from poem_jax.capture.take import Take


@pytest.fixture
def report(tmp_path, rig):
    with contextlib.closing(Report(tmp_path / "report.json", Take(rig, ("right",), []))) as report:
        yield report


def frame(name, *hands, warnings=(), problems=(), seen=3):
    boxes = np.full((1, 3, 4), np.nan)
    boxes[:, :seen] = 1.0
    return Frame(name, boxes, hands=hands, warnings=warnings, problems=problems)


def found(*errors):
    return HandResult(
        np.isfinite(errors),
        vertices_world=np.zeros((778, 3)),
        reprojection_px=np.array(errors),
        joints_shown=np.ones(3),
    )


def test_the_whole_report(report, tmp_path):
    assert report.add(frame("a", found(1.0, 2.0, np.nan), warnings=("odd",))) == ["odd"]
    lost = HandResult(np.ones(3, bool), "it is so")
    problem = ImageProblem(True, ValueError("broken.png cannot be read"))
    assert report.add(frame("b", lost, warnings=("odd", "odder"), problems=(problem,))) == ["odder"]
    report.write({"total": 1.5}, {"engine": "stub", "nothing": np.nan})
    content = json.loads((tmp_path / "report.json").read_text())
    first, second = content["frames"]
    assert first["hands"][0]["views_used"] == ["left_cam", "front"]
    assert first["hands"][0]["reprojection_px"] == {"left_cam": 1.0, "front": 2.0}
    assert second["hands"][0] == {
        "hand": "right",
        "valid": False,
        "views_used": ["left_cam", "front", "cam 3"],
        "reason": "it is so",
    }
    assert second["image_problems"] == ["broken.png cannot be read"]
    assert content["warnings"] == ["odd", "odder"]
    assert (content["num_frames"], content["num_hands"], content["solved_hands"]) == (2, 2, 1)
    assert content["failed_frames"] == 1
    assert content["reprojection"] == {
        "against": "the model's own heat maps",
        "mean_px": 1.5,
        "median_px": 1.5,
        "median_px_by_camera": {"left_cam": 1.0, "front": 2.0},
        "views_used": 5,
    }
    assert content["nothing"] is None
    assert content["frames_per_second"] is None
    assert content["median_joint_sigma_mm"] is None
    assert content["bridged_frames"] == {"right": 0}
    assert content["timings_s"] == {"total": 1.5}


def test_times_bridged_frames_and_uncertainty(report, tmp_path):
    for index, (time_s, bridged) in enumerate([(0.0, False), (0.04, True), (0.08, False), (0.5, False)]):
        hand = found(1.0, 2.0, np.nan)._replace(
            joint_sigma_m=np.full(21, 0.001 + index / 1000), bridged=bridged
        )
        report.add(frame(str(index), hand)._replace(time_s=time_s))
    content = json.loads(report.write({}, {}).read_text())
    assert content["frames_per_second"] == pytest.approx(25)
    assert content["bridged_frames"] == {"right": 1}
    assert content["median_joint_sigma_mm"] == pytest.approx(2.5)
    assert [entry["time_s"] for entry in content["frames"]] == [0.0, 0.04, 0.08, 0.5]
    assert [entry["hands"][0].get("bridged") for entry in content["frames"]] == [None, True, None, None]


def test_a_take_without_any_hand_ends_with_the_reason_that_matters(report):
    report.add(frame("a", HandResult(np.array([True, False, False]), "too few"), seen=2))
    report.add(frame("b", HandResult(np.ones(3, bool), "they do not meet"), seen=3))
    with pytest.raises(ValueError, match="no hand could be reconstructed: they do not meet"):
        report.check_any()
    report.add(frame("c", found(1.0, 1.0, 1.0)))
    report.check_any()


def test_a_stage_books_its_own_time_alone():
    clock = Clock()

    def slow(frames, seconds):
        for frame in frames:
            time.sleep(seconds)
            yield frame

    frames = clock.timed("first", slow(range(3), 0.02))
    frames = clock.timed("second", slow(frames, 0.05))
    for _ in frames:
        time.sleep(0.03)
    seconds = clock.rounded()
    assert seconds["first"] == pytest.approx(0.06, abs=0.03)
    assert seconds["second"] == pytest.approx(0.15, abs=0.04)
    assert seconds["write"] == pytest.approx(0.09, abs=0.04)
    assert seconds["total"] == pytest.approx(sum(seconds.values()) - seconds["total"], abs=0.01)
