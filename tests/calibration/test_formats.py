"""One rig, written in each format and read again, images the same points at the same pixels."""

import logging

import numpy as np
import pytest

from poem_jax.calibration.read_calibration import find_calibrations, read_calibration
from poem_jax.calibration.write_calibration import FORMATS, write_calibration
from poem_jax.geometry.transforms import transform_points
from tests.calibration.rigs_of_all_lenses import (
    EIGHT,
    FISHEYE,
    FIVE,
    FOUR,
    FOURTEEN,
    NO_LENS,
    TWELVE,
    ring_of,
    seen_by,
    some_points,
)

MIXED = (FIVE, FISHEYE, NO_LENS, EIGHT)
HELD = {
    "rig": (FIVE, FISHEYE, NO_LENS, EIGHT, TWELVE, FOURTEEN),
    "opencv": (FIVE, FISHEYE, NO_LENS, EIGHT, TWELVE, FOURTEEN),
    "anipose": (FIVE, FISHEYE, NO_LENS, EIGHT, TWELVE, FOURTEEN),
    "colmap": MIXED,
    "nerfstudio": (FIVE, FOUR, NO_LENS),
    "easymocap": (FIVE, NO_LENS, EIGHT, TWELVE, FOURTEEN),
    "panoptic": (FIVE, FOUR, NO_LENS),
    "voxelpose": (FIVE, FOUR, NO_LENS),
    "kalibr": (FOUR, FISHEYE, NO_LENS),
    "openpose": (FIVE, EIGHT, NO_LENS),
}
"""What each format can hold, all at once."""
SUFFIX = {"rig": ".json", "opencv": ".yml", "anipose": ".toml", "kalibr": ".yaml"}
SUFFIX |= dict.fromkeys(("nerfstudio", "panoptic", "voxelpose"), ".json")
WITH_SKEW = ("rig", "opencv", "anipose", "easymocap", "panoptic", "openpose")
REFUSED = [
    ("colmap", TWELVE, "thin prisms of camera 'cam_1'"),
    ("nerfstudio", EIGHT, "rational terms k4 k5 k6 of camera 'cam_1'"),
    ("nerfstudio", FISHEYE, "one model of the lens for all cameras"),
    ("easymocap", FISHEYE, "fisheye of camera 'cam_1'"),
    ("panoptic", FISHEYE, "fisheye of camera 'cam_1'"),
    ("panoptic", EIGHT, "rational terms"),
    ("voxelpose", FISHEYE, "fisheye of camera 'cam_1'"),
    ("kalibr", FIVE, "the term k3 of camera 'cam_1'"),
    ("openpose", FISHEYE, "fisheye of camera 'cam_1'"),
    ("openpose", FOURTEEN, "a tilted sensor of camera 'cam_1'"),
]


def path_of(tmp_path, name):
    return tmp_path / f"written{SUFFIX.get(name, '')}"


def again(tmp_path, rig, name):
    return read_calibration(write_calibration(path_of(tmp_path, name), rig, name))


def assert_same(got, rig, name):
    points = some_points()
    expected = seen_by(rig, points)
    if name == "kalibr":  # Its world is the first camera.
        points = transform_points(rig.T_cam_from_world[0], points)
    assert got.names == rig.names
    np.testing.assert_array_equal(got.size_wh, rig.size_wh)
    np.testing.assert_allclose(seen_by(got, points), expected, rtol=0, atol=1e-6)


def test_every_format_is_tested():
    assert set(HELD) == set(FORMATS)


@pytest.mark.parametrize("name", FORMATS)
def test_a_rig_comes_back(tmp_path, name):
    rig = ring_of(*HELD[name], skew=0.7 if name in WITH_SKEW else 0.0)
    got = again(tmp_path, rig, name)
    assert_same(got, rig, name)
    np.testing.assert_array_equal(got.fisheye, rig.fisheye)


def test_fisheyes_alone_come_back_through_transforms_json(tmp_path):
    rig = ring_of(FISHEYE, FISHEYE)
    assert_same(again(tmp_path, rig, "nerfstudio"), rig, "nerfstudio")


def test_opencv_writes_xml(tmp_path):
    rig = ring_of(*MIXED)
    assert_same(read_calibration(write_calibration(tmp_path / "rig.xml", rig)), rig, "opencv")


@pytest.mark.parametrize(("name", "lens", "message"), REFUSED)
def test_what_a_format_cannot_hold_is_named_and_nothing_written(tmp_path, name, lens, message):
    path = path_of(tmp_path, name)
    with pytest.raises(ValueError, match=f"cannot hold.*{message}|{message}"):
        write_calibration(path, ring_of(NO_LENS, lens), name)
    assert not path.exists()


@pytest.mark.parametrize("name", sorted(set(FORMATS) - set(WITH_SKEW)))
def test_skew_is_refused_where_it_has_no_place(tmp_path, name):
    with pytest.raises(ValueError, match=r"skew of camera 'cam_0', 0\.7 px"):
        write_calibration(path_of(tmp_path, name), ring_of(NO_LENS, NO_LENS, skew=0.7), name)


def test_the_ending_tells_the_format(tmp_path):
    rig = ring_of(FOUR, NO_LENS)
    for suffix in (".json", ".toml", ".yml", ".xml"):
        got = read_calibration(write_calibration(tmp_path / f"rig{suffix}", rig))
        assert_same(got, rig, "rig")
    with pytest.raises(ValueError, match="ending does not tell the format; give --format, one of rig"):
        write_calibration(tmp_path / "rig", rig)
    with pytest.raises(ValueError, match=r"format anipose ends with \.toml"):
        write_calibration(tmp_path / "rig.json", rig, "anipose")
    with pytest.raises(ValueError, match="the format must be one of"):
        write_calibration(tmp_path / "rig.json", rig, "blender")


@pytest.mark.parametrize("unit", ["millimetre", "cm", 0.5])
def test_a_unit_that_is_told_goes_before_the_file_s(tmp_path, unit, caplog):
    rig = ring_of(FOUR, NO_LENS)
    metres = {"millimetre": 1e-3, "cm": 1e-2, 0.5: 0.5}[unit]
    path = write_calibration(tmp_path / "rig.json", rig)
    got = read_calibration(path, unit=unit)
    np.testing.assert_allclose(got.T_cam_from_world[:, :3, 3], metres * rig.T_cam_from_world[:, :3, 3])
    assert "is in metres by itself" in caplog.text
    with pytest.raises(ValueError, match=r"the unit must be one of metre, .*; got 'furlong'"):
        read_calibration(path, unit="furlong")


@pytest.mark.parametrize("name", FORMATS)
def test_a_size_that_is_told_must_be_the_file_s(tmp_path, name):
    rig = ring_of(NO_LENS, NO_LENS)
    path = write_calibration(path_of(tmp_path, name), rig, name)
    width, height = map(int, rig.size_wh[0])
    assert_same(read_calibration(path, image_size=(width, height)), rig, name)
    with pytest.raises(ValueError, match=rf"are {width} x {height} by the file; got 64 x 48: leave the size"):
        read_calibration(path, image_size=(64, 48))


@pytest.mark.parametrize(("scale", "unit"), [(1000.0, "millimetre"), (1.0, "metre")])
def test_the_custom_under_which_cameras_stand_apart_as_cameras_do(tmp_path, scale, unit, caplog):
    """anipose says no unit: its board's, which is millimetres mostly, and metres with Pose2Sim."""
    rig = ring_of(FOUR, NO_LENS)
    path = write_calibration(tmp_path / "rig.toml", rig)
    text = path.read_text().replace('unit = "millimetre"', "")
    T = rig.T_cam_from_world[:, :3, 3]
    for i in range(2):
        text = text.replace(str((1e3 * T[i]).tolist()), str((scale * T[i]).tolist()))
    path.write_text(text)
    with caplog.at_level(logging.WARNING):
        got = read_calibration(path)
    np.testing.assert_allclose(got.T_cam_from_world[:, :3, 3], T, atol=1e-12)
    assert f"does not say its unit; read as {unit}s" in caplog.text


def test_a_unit_that_nobody_can_know_is_asked_for(tmp_path):
    rig = ring_of(FOUR, NO_LENS)
    path = write_calibration(tmp_path / "colmap", rig, "colmap")
    images = path / "images.txt"
    far = rig._replace(T_cam_from_world=rig.T_cam_from_world.copy())
    far.T_cam_from_world[:, :3, 3] *= 1000
    write_calibration(path, far, "colmap")
    with pytest.raises(ValueError, match=r"would stand .* m if in metres apart: say it .* --unit"):
        read_calibration(images)
    got = read_calibration(images, unit="mm")
    np.testing.assert_allclose(got.T_cam_from_world, rig.T_cam_from_world, atol=1e-12)


@pytest.mark.parametrize("name", ["colmap", "easymocap", "openpose"])
def test_any_file_of_several_finds_the_others(tmp_path, name):
    rig = ring_of(*HELD[name])
    folder = write_calibration(tmp_path / "folder", rig, name)
    for path in folder.iterdir():
        if path.name != "points3D.txt":
            assert_same(read_calibration(path), rig, name)
    assert len(find_calibrations(folder)) == 1


def test_a_folder_holds_one_calibration(tmp_path):
    rig = ring_of(FOUR, NO_LENS)
    with pytest.raises(FileNotFoundError, match="no calibration in"):
        read_calibration(tmp_path)
    (tmp_path / "notes.txt").write_text("the cameras were moved at noon")
    (tmp_path / "picture.json").write_bytes(b"\xff\xd8\xff\xe0")
    write_calibration(tmp_path / "a.toml", rig)
    assert_same(read_calibration(tmp_path), rig, "anipose")
    write_calibration(tmp_path / "b.yml", rig)
    with pytest.raises(ValueError, match=r"holds 2 calibrations: a\.toml; b\.yml; give the one"):
        read_calibration(tmp_path)


def test_images_are_named_by_what_tells_them_apart(tmp_path):
    rig = ring_of(FOUR, NO_LENS)
    path = write_calibration(tmp_path / "colmap", rig, "colmap") / "images.txt"
    text = path.read_text()
    path.write_text(
        text.replace("cam_0.jpg", "take/left/0001.png").replace("cam_1.jpg", "take/right/0001.png")
    )
    assert read_calibration(path).names == ("left", "right")
    path.write_text(text.replace("cam_0.jpg", "a.png").replace("cam_1.jpg", "a.png"))
    with pytest.raises(ValueError, match=r"the image a\.png comes twice"):
        read_calibration(path)
