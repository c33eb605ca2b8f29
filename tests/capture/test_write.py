"""What is written, what of an earlier run is removed, and what happens when writing cannot be done."""

import numpy as np
import pytest

from poem_jax.capture import page_pictures, write
from poem_jax.capture.boxes_file import write_boxes


def test_the_page_of_a_long_take_is_thinned_among_the_frames_with_a_hand(
    make_capture, tmp_path, run, monkeypatch
):
    pages = []
    monkeypatch.setattr(page_pictures, "PAGE_FRAMES", 2)
    monkeypatch.setattr(write, "write_page", lambda path, frames, *_: pages.append(frames) or path)
    capture = make_capture(7)
    capture.hands.boxes_px[::2] = np.nan
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    run(capture, tmp_path / "out")
    assert [frame.name for frame in pages[0]] == ["0003", "0015"]
    assert all(frame.hands for frame in pages[0])


def test_a_page_that_cannot_be_recorded_costs_the_page_alone(
    make_capture, tmp_path, run, monkeypatch, caplog
):
    def no_port(*_):
        raise OSError("no free port")

    monkeypatch.setattr(write, "write_page", no_port)
    run(make_capture(), tmp_path / "out")
    assert (tmp_path / "out" / "report.json").exists()
    assert "the 3D page cannot be written, everything else is: no free port" in caplog.text


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
