"""`poem inspect`: what is recognised, what is printed, and the sheet that is drawn."""

import cv2
import numpy as np
import pytest

from poem_jax.calibration.write_calibration import write_calibration
from poem_jax.cli import main
from poem_jax.mixture.config import CapturesSource
from poem_jax.mixture.recognise import Kind, recognise, source_at
from tests.data.sources.test_captures import write_capture
from tests.rigs import small_rig


@pytest.fixture
def capture(tmp_path):
    write_capture(tmp_path / "desk")
    return tmp_path / "desk"


def test_a_capture_is_recognised_told_and_drawn(capture, tmp_path, capsys):
    assert main(["inspect", str(capture), "--out", str(tmp_path / "sheet.png"), "--samples", "2"]) == 0
    told = capsys.readouterr().out
    assert "captures desk: 6 samples of up to 3 views" in told
    assert "3 a sample: left_cam, front, cam 3" in told
    assert "240 x 180" in told
    assert "pose_cam, shape, mirror_px (1), dist" in told.replace("mirror_px,", "mirror_px (1),")
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[1] == 3 * 256


def test_corrupt_samples_are_named_and_the_others_shown(capture, capsys):
    (capture / "frames" / "0000" / "front.png").unlink()
    labels = dict(np.load(capture / "labels.npz"))
    labels["vertices_world"][0] *= 20
    np.savez(capture / "labels.npz", **labels)
    assert main(["inspect", str(capture), "--samples", "6"]) == 0
    told = capsys.readouterr().out
    assert told.count("corrupt ") == 2
    assert "sample desk/0/right" in told


TREES = {
    Kind.DEXYCB: ["calibration/extrinsics_20200702_151821/extrinsics.yml"],
    Kind.HO3D_V2: ["train.txt", "train/ABF10/rgb/0000.png"],
    Kind.HO3D_V3: ["HO3D_v3/train.txt", "HO3D_v3/train/ABF10/rgb/0000.jpg"],
    Kind.OAKINK: ["OakInk/image/anno/seq_all.json", "OakInk/image/stream_release_v2/x/y.png"],
    Kind.ARCTIC: ["arctic_data/data/raw_seqs/s01/box_grab_01.mano.npy"],
    Kind.INTERHAND: ["annotations/test/InterHand2.6M_test_data.json"],
    Kind.FREIHAND: ["training/rgb/00000000.jpg", "training_xyz.json"],
    Kind.TARS: ["DexYCB_mv_test-000000.tar"],
    Kind.CAPTURE: ["calibration/rig.json"],
}


def plant(root, names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"")


def test_hidden_files_make_no_folder_of_tars(tmp_path):
    plant(tmp_path, [*TREES[Kind.FREIHAND], "._DexYCB_mv_test-000000.tar"])
    assert recognise(tmp_path) is Kind.FREIHAND


@pytest.mark.parametrize("kind", TREES, ids=str)
def test_folders_are_recognised_by_what_lies_in_them(kind, tmp_path):
    plant(tmp_path, TREES[kind])
    assert recognise(tmp_path) is kind


def test_a_capture_is_opened_with_the_users_mano(tmp_path):
    source = source_at(tmp_path, Kind.CAPTURE, split=None, mano="MANO_LEFT.pkl")
    assert source == CapturesSource((str(tmp_path),), mano="MANO_LEFT.pkl")


def test_patterns_and_files_of_tars_are_tars():
    assert recognise("x/DexYCB_mv_test-{000000..000003}.tar") is Kind.TARS
    assert recognise("x/*.tar") is Kind.TARS


@pytest.mark.parametrize("name", ["rig.toml", "calibration/rig.toml"])
def test_a_capture_may_have_the_calibration_of_another_tool(name, tmp_path):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    write_calibration(tmp_path / name, small_rig())
    with pytest.raises(ValueError, match="none that is known"):
        recognise(tmp_path)
    (tmp_path / "frames").mkdir()
    assert recognise(tmp_path) is Kind.CAPTURE


def test_what_is_not_recognised_says_what_could_be(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing that could be a data set"):
        recognise(tmp_path / "missing")
    (tmp_path / "notes").mkdir()
    with pytest.raises(ValueError, match=r"--kind, one of tars, capture.*it holds notes"):
        recognise(tmp_path)
    plant(tmp_path, TREES[Kind.FREIHAND] + TREES[Kind.TARS])
    with pytest.raises(ValueError, match="could be tars or freihand"):
        recognise(tmp_path)


@pytest.mark.parametrize("kind", [k for k in Kind if k not in (Kind.TARS, Kind.CAPTURE)], ids=str)
def test_every_kind_has_its_source_and_says_when_it_needs_mano(kind, tmp_path):
    source = source_at(tmp_path, kind, split="test", mano="MANO_RIGHT.pkl")
    assert (source.root, source.split, source.mano) == (str(tmp_path), "test", "MANO_RIGHT.pkl")
    if kind not in (Kind.OAKINK, Kind.FREIHAND):
        with pytest.raises(ValueError, match=r"give --mano MANO_RIGHT\.pkl"):
            source_at(tmp_path, kind, split=None, mano=None)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "say what to inspect"),
        (["--miniature", "kinect", "--out", "x"], "--miniature must be one of"),
        (["--miniature", "freihand"], "needs --out DIR"),
        (["x", "--samples", "0"], "--samples must be at least 1"),
    ],
)
def test_wrong_arguments_are_said(arguments, message, capsys):
    assert main(["inspect", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_a_miniature_is_written_and_inspected(tmp_path, capsys):
    assert main(["inspect", "--miniature", "tars-freihand", "--out", str(tmp_path / "mini")]) == 0
    assert "samples of up to 1 views" in capsys.readouterr().out
    assert (tmp_path / "mini" / "contact_sheet.png").is_file()
