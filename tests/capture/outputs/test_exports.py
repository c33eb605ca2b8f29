"""What a whole run writes of a take, by what was chosen; and what is left if a part of it fails."""

import json

import cv2
import numpy as np
import pytest

from poem_jax.capture import write
from poem_jax.capture.outputs import exports
from poem_jax.capture.outputs.formats import DEFAULT_FORMATS, Format
from poem_jax.capture.report import Clock
from poem_jax.capture.write import Style, write_results
from tests.capture.outputs.conftest import HANDS

OVERLAYS = ("overlays/left_cam.mp4", "overlays/front.mp4", "overlays/cam 3.mp4")


@pytest.fixture(autouse=True)
def no_page(monkeypatch):
    monkeypatch.setattr(write, "write_page", lambda path, *_, **__: path)


def run(planted, out, formats, hands=HANDS, pictures=False):
    frames = planted.frames
    if pictures:
        images = tuple(np.full((180, 240, 3), 90, np.uint8) for _ in range(3))
        frames = [frame._replace(images=images) for frame in frames]
    faces = {side: hand.faces for side, hand in HANDS.items()}
    style = Style(faces, False, True, planted.origin, hands, formats)
    write_results(iter(frames), planted.take, out, style, Clock(), {"engine": "planted"})
    return {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}


def test_what_is_chosen_is_written(planted, tmp_path):
    always = {"prediction.npz", "report.json"}
    take = planted()
    assert run(take, tmp_path / "a", DEFAULT_FORMATS) == always | {"hands.glb"}
    assert run(take, tmp_path / "b", frozenset({Format.TRC})) == always | {"hands.trc"}
    all_names = {
        "hands.glb",
        "right.bvh",
        "left.bvh",
        "joints.csv",
        "joint_angles.csv",
        "hands.trc",
        "mano.npz",
    }
    assert run(take, tmp_path / "c", frozenset(Format)) == always | all_names
    report = json.loads((tmp_path / "c" / "report.json").read_text())
    assert report["animation"]["right"]["moves_by"] == "skeleton"
    assert report["bridged_frames"] == {"right": 1, "left": 1}
    assert report["frames_per_second"] == pytest.approx(25)


def test_overlays_of_a_long_take_are_videos(planted, tmp_path, monkeypatch):
    monkeypatch.setattr(write, "draw_views", lambda frame, *_: frame.images)
    one = {"0003/overlay_front.png"}
    short = run(planted(), tmp_path / "a", DEFAULT_FORMATS, pictures=True)
    assert one <= short
    assert not short & set(OVERLAYS)
    long = run(planted(25), tmp_path / "b", DEFAULT_FORMATS, pictures=True)
    assert set(OVERLAYS) <= long
    assert not any(name.endswith(".png") for name in long)
    both = run(planted(), tmp_path / "c", frozenset({Format.VIDEO, Format.PNG}), pictures=True)
    assert one | set(OVERLAYS) <= both
    video = cv2.VideoCapture(str(tmp_path / "b" / "overlays" / "front.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 25
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(25)


def test_without_a_hand_model_the_mesh_moves_by_itself_and_the_rest_is_told(planted, tmp_path, caplog):
    names = run(planted(), tmp_path, frozenset({Format.GLB, Format.BVH, Format.MANO}), hands=None)
    assert names == {"prediction.npz", "report.json", "hands.glb"}
    assert "no hand model is known: bvh and mano is not written" in caplog.text
    assert json.loads((tmp_path / "report.json").read_text())["animation"]["left"]["moves_by"] == "vertices"


def test_files_of_an_earlier_run_are_told_and_its_animation_goes(planted, tmp_path, caplog):
    run(planted(), tmp_path, frozenset({Format.GLB, Format.CSV}))
    names = run(planted(), tmp_path, frozenset({Format.TRC}))
    assert "joints.csv is of an earlier run, and does not belong to these results" in caplog.text
    assert "hands.glb" not in names
    assert {"joints.csv", "hands.trc"} <= names


def test_a_file_that_cannot_be_written_costs_itself_alone(planted, tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(exports, "write_markers", full)
    with pytest.raises(OSError, match="no space left"):
        run(planted(), tmp_path, frozenset({Format.CSV, Format.TRC, Format.VIDEO}), pictures=True)
    assert (tmp_path / "joints.csv").exists()
    assert (tmp_path / "overlays" / "front.mp4").exists()
    assert json.loads((tmp_path / "report.json").read_text())["num_frames"] == 9
    with np.load(tmp_path / "prediction.npz") as stored:
        assert len(stored["time_s"]) == 9


def test_an_interruption_leaves_all_kinds_of_files(planted, tmp_path):
    take = planted()

    def stopped():
        yield from take.frames[:5]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(take._replace(frames=stopped()), tmp_path, frozenset(Format))
    for name in ("hands.glb", "right.bvh", "joints.csv", "hands.trc", "mano.npz", "report.json"):
        assert (tmp_path / name).exists(), name
    assert len((tmp_path / "joints.csv").read_text().splitlines()) == 6
