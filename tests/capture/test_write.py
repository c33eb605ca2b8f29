"""What is written, what of an earlier run is removed, and what happens when writing cannot be done."""

import numpy as np
import pytest

from poem_jax.capture import write
from poem_jax.capture.boxes_file import write_boxes
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.outputs import page
from poem_jax.capture.outputs.prediction import prediction_entry
from poem_jax.capture.write import frame_folder


def test_the_page_of_a_long_take_is_thinned_among_the_frames_with_a_hand(
    make_capture, tmp_path, run, monkeypatch
):
    pages = []
    monkeypatch.setattr(page, "PAGE_FRAMES", 2)
    monkeypatch.setattr(write, "write_page", lambda path, frames, *_, **__: pages.append(frames) or path)
    capture = make_capture(7)
    capture.hands.boxes_px[::2] = np.nan
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    run(capture, tmp_path / "out")
    assert [frame.name for frame in pages[0]] == ["0003", "0015"]
    assert all(frame.hands for frame in pages[0])


def test_a_page_that_cannot_be_written_costs_the_page_alone(make_capture, tmp_path, run, monkeypatch, caplog):
    def full(*_, **__):
        raise OSError("no space left")

    monkeypatch.setattr(write, "write_page", full)
    run(make_capture(), tmp_path / "out")
    assert (tmp_path / "out" / "report.json").exists()
    assert "the 3D page cannot be written, everything else is: no space left" in caplog.text


def test_a_new_run_removes_its_own_meshes_of_hands_that_it_lost(make_capture, tmp_path, run):
    capture = make_capture(2, ("right", "left"))
    out = tmp_path / "out"
    run(capture, out, meshes=True)
    mine = out / "0000" / "mine.obj"
    mine.write_text("not this command's")
    capture.hands.boxes_px[0, 1] = np.nan
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    (out / "0000" / "left.obj").write_text("drawn anew by hand")
    run(capture, out, meshes=True)
    meshes = {path.relative_to(out).as_posix() for path in out.rglob("*.obj")}
    expected = {"0000/right.obj", "0000/left.obj", "0000/mine.obj", "0003/right.obj", "0003/left.obj"}
    assert meshes == expected
    assert (out / "0000" / "left.obj").read_text() == "drawn anew by hand"
    assert not (out / "0000" / "left.glb").exists()


def test_results_need_a_folder(make_capture, tmp_path, run):
    capture = make_capture()
    (tmp_path / "file").write_text("keep")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match=r"results go to a folder, and .*file is a file; give another"):
            run(capture, out)
    assert (tmp_path / "file").read_text() == "keep"


def found(value, **more):
    points = {"vertices_world": (778, 3), "joints_world": (21, 3), "root_world": (3,)}
    arrays = {name: np.full(shape, value, np.float32) for name, shape in points.items()}
    return HandResult(np.ones(3, bool), reprojection_px=np.array([1.0, np.nan, value]), **arrays, **more)


def test_the_entry_of_a_frame_is_nan_where_a_hand_is_lost():
    lost = HandResult(np.array([True, False, False]), "seen in 1 view(s); two are needed")
    frame = Frame("a", np.full((2, 3, 4), np.nan), hands=(lost, found(2.0, shape=np.arange(10.0))))
    entry = prediction_entry(frame, np.zeros(3))
    assert entry["valid"].tolist() == [False, True]
    assert entry["views_used"].tolist() == [[True, False, False], [True, True, True]]
    assert np.isnan(entry["vertices_world"][0]).all()
    assert (entry["vertices_world"][1] == 2).all()
    np.testing.assert_array_equal(entry["reprojection_px"][1], [1, np.nan, 2])
    np.testing.assert_array_equal(entry["shape"][1], np.arange(10))
    assert np.isnan(entry["pose"]).all()
    assert entry["joints_world"].dtype == np.float32
    assert np.isnan(entry["joint_confidence"]).all()
    assert np.isnan(entry["time_s"])
    assert entry["bridged"].tolist() == [False, False]


def test_the_entry_of_a_frame_tells_its_time_what_is_bridged_and_what_bears_a_hand_out():
    confidence = np.linspace(0, 1, 63).reshape(3, 21)
    hand = found(2.0, joint_confidence=confidence, bridged=True)
    entry = prediction_entry(Frame("a", np.full((1, 3, 4), np.nan), hands=(hand,), time_s=1.25), np.zeros(3))
    assert entry["time_s"] == 1.25
    assert entry["bridged"].tolist() == [True]
    np.testing.assert_allclose(entry["joint_confidence"][0], confidence, atol=1e-7)


def test_a_far_world_keeps_its_millimetres():
    """500 km from the origin float32 would round by 3 cm."""
    origin = np.array([500e3, 4500e3, 300.0])
    place = np.array([0.001, 0.002, 0.003])
    frame = Frame("a", np.full((1, 3, 4), np.nan), hands=(found(0.001, translation=place),))
    entry = prediction_entry(frame, origin)
    np.testing.assert_allclose(entry["joints_world"][0] - origin, 0.001, atol=1e-6)
    np.testing.assert_allclose(entry["translation"][0] - origin, place, atol=1e-6)


@pytest.mark.parametrize(
    "name", ["../mine", "/tmp/mine", "", ".", "..", "a/b", "prediction.npz", "a\0b", "x" * 300]
)
def test_nothing_is_written_outside_the_folder(tmp_path, name):
    with pytest.raises(ValueError, match="name"):
        frame_folder(tmp_path, name)


def test_a_link_that_leads_elsewhere_is_not_followed(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "0000").symlink_to(tmp_path / "mine")
    with pytest.raises(ValueError, match="is a link that leads out of the folder of results"):
        frame_folder(tmp_path / "out", "0000")


@pytest.mark.parametrize("name", ["prediction.npz", "report.json", "index.html", "hands.glb", "right.bvh"])
def test_a_folder_with_the_name_of_a_result_is_found_before_the_work(make_capture, tmp_path, run, name):
    mine = tmp_path / "out" / name / "mine"
    mine.parent.mkdir(parents=True)
    mine.write_text("keep")
    with pytest.raises(ValueError, match=rf"{name} is a folder, and a file of the results has this name"):
        run(make_capture(), tmp_path / "out")
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == [mine]


def test_a_file_with_the_name_of_a_frame(tmp_path):
    (tmp_path / "0003").write_text("keep")
    with pytest.raises(ValueError, match=r"0003 is a file, and the folder of a frame has this name"):
        write.frame_folder(tmp_path, "0003")
