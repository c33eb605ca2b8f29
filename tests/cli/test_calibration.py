"""`poem calibration`: exit codes, one line a finding, what is written and what is refused."""

import json

import cv2
import numpy as np
import pytest

from poem_jax.calibration.read_calibration import read_calibration
from poem_jax.calibration.rig_json import read_rig, write_rig
from poem_jax.calibration.write_calibration import write_calibration
from poem_jax.capture import detect
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints, read_boxes, write_boxes
from poem_jax.cli.run import main, parse
from tests.calibration.conftest import make_ring
from tests.calibration.planted_faults import FAULTS
from tests.calibration.test_linter import moving_take
from tests.capture.test_rig_refinement import off, touched


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with `rig.json` and `keypoints.npz`, and the rig."""
    folder = tmp_path_factory.mktemp("calibration")
    rig, uv = moving_take(frames=90, noise_px=0.5)
    write_rig(folder / "rig.json", rig)
    write_boxes(folder / "keypoints.npz", HandBoxes(boxes_from_keypoints(uv), ("right",), None, uv))
    return folder, rig


def poem(*arguments):
    return main(["calibration", *map(str, arguments)])


def test_a_good_rig_passes(files, tmp_path, capsys):
    folder, _ = files
    out = tmp_path / "out"
    assert poem("check", folder / "rig.json", "--keypoints", folder / "keypoints.npz", "--out", out) == 0
    assert "nothing is wrong" in capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    assert report["findings"] == []
    assert len(report["pairs_px"]) == 6
    picture = cv2.imread(str(out / "rig.png"))
    assert (picture != 255).any(-1).mean() > 0.005


def test_a_fault_is_told_in_one_line(files, tmp_path, capsys):
    folder, rig = files
    wrong, _ = FAULTS["OpenGL axes"][0](rig, np.zeros((1, 1, 4, 21, 2)))
    write_rig(tmp_path / "wrong.json", wrong)
    assert poem("check", tmp_path / "wrong.json", "--keypoints", folder / "keypoints.npz") == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("camera axes: ")
    assert poem("check", tmp_path / "wrong.json") == 1


def test_a_rig_that_cannot_be_read_is_a_finding(tmp_path, capsys):
    (tmp_path / "rig.json").write_text('{"unit": "furlong", "cameras": []}')
    assert poem("check", tmp_path / "rig.json", "--out", tmp_path / "out") == 1
    assert "unit" in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / "report.json").read_text())["findings"][0]["name"] == "unreadable"
    assert poem("check", tmp_path / "none.json") == 2


def test_images_are_drawn_on(files, tmp_path):
    folder, rig = files
    captured = tmp_path / "capture"
    for frame in range(90):
        (captured / "frames" / f"{frame:04d}").mkdir(parents=True)
    for name in rig.names:
        cv2.imwrite(str(captured / "frames" / "0000" / f"{name}.png"), np.zeros((720, 1280, 3), np.uint8))
    out = tmp_path / "out"
    keypoints = folder / "keypoints.npz"
    check = ["check", folder / "rig.json", "--keypoints", keypoints, "--images", captured, "--out", out]
    assert poem(*check) == 0
    drawn = cv2.imread(str(out / f"0000_{rig.names[1]}.jpg"))
    assert drawn.shape == (720, 1280, 3)
    assert drawn.any()


def test_images_alone_are_searched_first_and_an_unreadable_one_is_told(files, tmp_path, monkeypatch, caplog):
    folder, rig = files
    hands = read_boxes(folder / "keypoints.npz")
    names = tuple(f"{frame:04d}" for frame in range(len(hands.boxes_px)))
    monkeypatch.setattr(detect, "detect_hands", lambda frames, *_, **__: hands._replace(frames=names))
    captured, out = tmp_path / "capture", tmp_path / "out"
    for name in names:
        (captured / "frames" / name).mkdir(parents=True)
    for name in rig.names:
        cv2.imwrite(str(captured / "frames" / "0000" / f"{name}.png"), np.zeros((720, 1280, 3), np.uint8))
    (captured / "frames" / "0000" / f"{rig.names[0]}.png").write_bytes(b"no picture")
    assert poem("check", folder / "rig.json", "--images", captured, "--out", out) == 0
    assert "0000 is not drawn on" in caplog.text
    assert json.loads((out / "report.json").read_text())["frames"] == len(names)
    assert (out / f"0000_{rig.names[1]}.jpg").exists()
    assert poem("check", folder / "rig.json", "--images", captured) == 2


def test_a_touched_rig_is_refined_and_a_good_one_is_not(files, tmp_path, capsys):
    folder, rig = files
    write_rig(tmp_path / "touched.json", touched(rig, 2, 1.0, 0.01))
    keypoints, out = folder / "keypoints.npz", tmp_path / "refined.json"
    assert poem("refine", tmp_path / "touched.json", "--keypoints", keypoints, "--out", out) == 0
    degrees, metres = off(read_rig(out), rig)
    assert degrees.max() < 0.1
    assert metres.max() < 0.001
    assert "right: turned 1.0" in capsys.readouterr().out
    assert poem("refine", folder / "rig.json", "--keypoints", keypoints, "--out", tmp_path / "no.json") == 2
    assert not (tmp_path / "no.json").exists()
    assert "not written" in capsys.readouterr().err
    assert poem("refine", folder / "rig.json", "--keypoints", keypoints, "--out", folder / "rig.json") == 2


def test_the_arguments_of_convert():
    command = parse(["calibration", "convert", "in.toml", "out.json", "--unit", "millimetre"])
    assert command.action.unit == "millimetre"
    assert command.action.format is None


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("made", "format", "arguments", "lost"),
    [
        ("calib", "easymocap", ("calib/intri.yml", "calib/extri.yml"), "calib/extri.yml"),
        ("calib/rig.json", "rig", ("calib", "calib/rig.json"), "calib/rig.json"),
        ("calib", "colmap", ("calib/cameras.txt", "calib", "--format", "colmap"), "calib/cameras.txt"),
        ("calib", "colmap", ("calib", "link", "--format", "colmap"), "link/cameras.txt"),
        (
            "calib/rig.toml",
            "anipose",
            ("calib/rig.toml", "calib", "--format", "colmap"),
            "calib/points3D.txt",
        ),
        ("calib/rig.toml", "anipose", ("link.toml", "calib/rig.toml"), "calib/rig.toml"),
    ],
)
def test_convert_replaces_nothing_beside_what_it_reads(
    tmp_path, monkeypatch, capsys, made, format, arguments, lost
):
    monkeypatch.chdir(tmp_path)
    write_calibration(made, make_ring(3), format)
    (tmp_path / "calib" / "points3D.txt").write_text("1 0 0 1 255 0 0 0.5\n")
    (tmp_path / "link").symlink_to("calib")
    (tmp_path / "link.toml").symlink_to("calib/rig.toml")
    before = contents(tmp_path)
    assert poem("convert", *arguments) == 2
    error = capsys.readouterr().err
    assert f"{lost} would be replaced" in error
    assert "give another OUT" in error
    assert contents(tmp_path) == before


def test_convert_writes_beside_what_it_reads_and_over_what_it_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rig = make_ring(3)
    write_calibration("calib", rig, "easymocap")
    for out in ("calib/rig.json", "out/rig.toml", "out/rig.toml"):
        assert poem("convert", "calib/intri.yml", out) == 0
        np.testing.assert_allclose(read_calibration(out).T_cam_from_world, rig.T_cam_from_world, atol=1e-9)
    for _ in range(2):
        assert poem("convert", "out/rig.toml", ".", "--format", "colmap") == 0
    assert (tmp_path / "cameras.txt").is_file()
    assert poem("convert", "out/rig.toml", "out/rig") == 2
