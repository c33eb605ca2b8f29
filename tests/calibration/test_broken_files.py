"""Files that are cut off, empty, of another kind, or of one lens alone end in words that name the file."""

import json
import re
import shutil

import numpy as np
import pytest

from poem_jax.calibration.read_calibration import read_calibration
from poem_jax.calibration.rig_json import read_rig
from poem_jax.calibration.write_calibration import FORMATS, write_calibration
from tests.calibration.rigs_of_all_lenses import FISHEYE, FOUR, NO_LENS, ring_of

OWN = (ValueError, FileNotFoundError)
KINDS = {
    "rig": r"rig|cameras|JSON",
    "opencv": "OpenCV",
    "anipose": "anipose",
    "colmap": "COLMAP",
    "nerfstudio": "nerfstudio",
    "easymocap": "EasyMocap",
    "panoptic": "Panoptic",
    "voxelpose": "VoxelPose",
    "kalibr": "Kalibr",
    "openpose": "OpenPose",
}


@pytest.fixture(params=FORMATS)
def written(request, tmp_path):
    """Return a format's name, and the files of a rig in it, whole."""
    suffix = {"rig": ".json", "opencv": ".yml", "anipose": ".toml", "kalibr": ".yaml"}.get(request.param, "")
    suffix = ".json" if request.param in ("nerfstudio", "panoptic", "voxelpose") else suffix
    path = write_calibration(tmp_path / f"whole{suffix}", ring_of(FOUR, NO_LENS), request.param)
    files = (
        [path] if path.is_file() else sorted(file for file in path.iterdir() if file.name != "points3D.txt")
    )
    return request.param, files


def outcome(path):
    """Return what reading says, which must be a rig or an error of ours that names a file."""
    message = None
    try:
        read_calibration(path)
    except OWN as error:
        message = str(error)
    assert message is None or path.parent.name in message or path.name in message
    assert message is None or len(message) < 2000
    return message


def test_cut_off_anywhere(written):
    name, files = written
    for file in files:
        whole = file.read_bytes()
        for share in np.linspace(0, 0.97, 14):
            file.write_bytes(whole[: int(share * len(whole))])
            message = outcome(file)
            if 0.6 < share < 0.9 and name not in ("colmap", "easymocap", "kalibr"):
                assert message is not None
                assert re.search(KINDS[name], message)
        file.write_bytes(whole)


def test_characters_lost_or_changed(written):
    rng = np.random.default_rng(0)
    for file in written[1]:
        whole = bytearray(file.read_bytes())
        for _ in range(30):
            damaged = bytearray(whole)
            at = int(rng.integers(len(damaged)))
            if rng.random() < 0.5:
                del damaged[at : at + int(rng.integers(1, 40))]
            else:
                damaged[at] = int(rng.choice(np.frombuffer(b'"[]{}:,-.e0 \n<>#x\x00\xff', np.uint8)))
            file.write_bytes(damaged)
            outcome(file)
        file.write_bytes(whole)


def test_one_of_several_files_is_missing(written):
    name, files = written
    if name == "colmap":
        files[0].unlink()
        with pytest.raises(ValueError, match=r"images\.txt: COLMAP's cameras\.txt, the lenses, is missing"):
            read_calibration(files[1])
    if name == "easymocap":
        files[1].unlink()
        with pytest.raises(ValueError, match=r"extri\.yml: EasyMocap's intri\.yml, the lenses, is missing"):
            read_calibration(files[0])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty"),
        (b"  \n ", "is empty"),
        (b"\xff\xd8\xff\xe0", "not text but a JPEG image"),
        (b"PK\x03\x04\xff\xfe", "not text but an archive or .npz"),
        (b"\x93NUMPY\x01", "not text but a NumPy array"),
        (b"\x80\x04\x95", "not text but a pickle, which is not read"),
        (b"\x00\x00\x00\x20ftypisom\xff", "not text but a video"),
        (b"[1, 2, 3]", "no calibration that is known: it is JSON with no names"),
        (b'{"a": {"b": 1}}', "it is JSON with a, b"),
        (b"[project]\nname = 1\n", "it is TOML with name, project"),
        (b"<html><body/></html>", "it is XML with body, html"),
        (b"hello", "it is lines of text with no names"),
        (b'{"a": ', "cannot be read as JSON"),
        (b"[a\nb = ", "it is|cannot be read"),
    ],
)
def test_files_of_other_kinds(tmp_path, data, message):
    path = tmp_path / "calibration.json"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=message) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)


ROS = """image_width: 720
image_height: 720
camera_name: camera0
camera_matrix: {rows: 3, cols: 3, data: [900, 0, 360, 0, 900, 360, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
VICON = """<Cameras><Camera DEVICEID="1" SENSOR_SIZE="1920 1080"><KeyFrames>
<KeyFrame FOCAL_LENGTH="1000" ORIENTATION="0 0 0 1" POSITION="0 0 0" PRINCIPAL_POINT="960 540"/>
</KeyFrames></Camera></Cameras>"""
QUALISYS = """<calibration><cameras><camera serial="1"><fov_video left="0"/>
<intrinsic focalLengthU="1"/></camera></cameras></calibration>"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ROS, "looks like a ROS camera_info: it holds the lens of one camera alone"),
        (VICON, "looks like Vicon's XCP: .*Pose2Sim"),
        (QUALISYS, "looks like Qualisys's calibration: .*Pose2Sim"),
        ("project = 'x'\ncam_regex = 'c'\n", "configuration of an anipose project: .*calibration.toml"),
    ],
)
def test_known_kinds_that_hold_no_rig(tmp_path, text, message):
    path = tmp_path / "file"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_calibration(path)


def test_xml_entities_are_refused(tmp_path):
    path = write_calibration(tmp_path / "rig.xml", ring_of(FOUR, NO_LENS))
    path.write_text(
        path.read_text().replace("<opencv_storage>", '<!DOCTYPE x [<!ENTITY a "1">]><opencv_storage>')
    )
    with pytest.raises(ValueError, match=r"rig\.xml declares XML entities"):
        read_calibration(path)


def change(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


def test_a_lens_without_a_place_says_so(tmp_path):
    path = write_calibration(tmp_path / "rig.toml", ring_of(FOUR, NO_LENS))
    path.write_text(re.sub(r"(rotation|translation) = .*\n", "", path.read_text()))
    with pytest.raises(
        ValueError, match="'cam_0' has no `rotation` and no `translation`: it is calibrated by it"
    ):
        read_calibration(path)
    yml = write_calibration(tmp_path / "opencv" / "rig.yml", ring_of(FOUR, NO_LENS))
    content = yml.read_text()
    yml.write_text(content.replace("   R: !!", "   X: !!").replace("   T: !!", "   Y: !!"))
    with pytest.raises(
        ValueError, match="holds the lenses of cameras alone; a rig needs the places, R and T"
    ):
        read_calibration(yml)


def test_lenses_and_places_in_two_files_of_opencv(tmp_path):
    rig = ring_of(FOUR, FISHEYE)
    whole = write_calibration(tmp_path / "rig.yml", rig).read_text()
    (tmp_path / "lens.yml").write_text(re.sub(r"   [RT]: !!opencv-matrix(\n      .*)+", "", whole))
    lens = r"   (camera_matrix|distortion_coefficients): !!opencv-matrix(\n      .*)+"
    (tmp_path / "place.yml").write_text(re.sub(lens, "", whole))
    (tmp_path / "rig.yml").unlink()
    for name in ("lens.yml", "place.yml"):
        got = read_calibration(tmp_path / name)
        for a, b in zip(got[1:], rig[1:], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)
    shutil.copy(tmp_path / "place.yml", tmp_path / "place2.yml")
    with pytest.raises(ValueError, match=r"beside it lie several .*place\.yml, place2\.yml"):
        read_calibration(tmp_path / "lens.yml")


def test_rotations_of_easymocap_must_agree(tmp_path):
    rig = ring_of(FOUR, NO_LENS)
    folder = write_calibration(tmp_path / "e", rig, "easymocap")
    extri = folder / "extri.yml"
    text = extri.read_text()
    extri.write_text(text.replace("Rot_cam_0", "Xot_cam_0"))
    np.testing.assert_allclose(read_calibration(folder).T_cam_from_world, rig.T_cam_from_world, atol=1e-12)
    swapped = (
        text.replace("Rot_cam_0", "Rot_X").replace("Rot_cam_1", "Rot_cam_0").replace("Rot_X", "Rot_cam_1")
    )
    extri.write_text(swapped)
    with pytest.raises(
        ValueError, match=r"`R_cam_0`, a rotation vector, and `Rot_cam_0`, its matrix, differ"
    ):
        read_calibration(folder)


def test_models_of_the_lens_that_are_not_read_are_named(tmp_path):
    colmap = write_calibration(tmp_path / "c", ring_of(FOUR, NO_LENS), "colmap")
    change(colmap / "cameras.txt", "PINHOLE", "FOV")
    with pytest.raises(
        ValueError, match=r"camera 2: its model FOV is not read, only SIMPLE_PINHOLE, .*OPENCV_F"
    ):
        read_calibration(colmap)
    kalibr = write_calibration(tmp_path / "k.yaml", ring_of(FOUR, NO_LENS), "kalibr")
    change(kalibr, "camera_model: pinhole", "camera_model: omni")
    with pytest.raises(ValueError, match=r"'cam_0': of Kalibr's models pinhole .*; got omni with radtan"):
        read_calibration(kalibr)
    nerf = write_calibration(tmp_path / "n.json", ring_of(FOUR, NO_LENS), "nerfstudio")
    change(nerf, '"OPENCV"', '"EQUIRECTANGULAR"')
    with pytest.raises(ValueError, match="`camera_model` 'EQUIRECTANGULAR' is not read"):
        read_calibration(nerf)


def test_images_txt_without_its_lines_of_points(tmp_path):
    folder = write_calibration(tmp_path / "c", ring_of(FOUR, NO_LENS, NO_LENS), "colmap")
    images = folder / "images.txt"
    images.write_text("\n".join(line for line in images.read_text().splitlines() if line))
    with pytest.raises(ValueError, match="after the line of image 0 must stand one of its points"):
        read_calibration(folder)


def test_sizes_that_a_file_does_not_hold_are_asked_for(tmp_path):
    rig = ring_of(FOUR, NO_LENS)
    path = write_calibration(tmp_path / "v.json", rig, "voxelpose")
    content = json.loads(path.read_text())
    for camera in content.values():
        del camera["width"], camera["height"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"does not hold the size of the images: `poem calibration convert"):
        read_calibration(path)
    np.testing.assert_array_equal(read_calibration(path, image_size=(1280, 720)).size_wh, rig.size_wh)
    whole = write_calibration(tmp_path / "rig.toml", rig)
    with pytest.raises(ValueError, match="1280 x 720 by the file; got 640 x 480: leave the size out"):
        read_calibration(whole, image_size=(640, 480))


def test_a_reader_of_one_kind_says_what_another_is(tmp_path):
    path = write_calibration(tmp_path / "p.json", ring_of(FOUR, NO_LENS), "panoptic")
    with pytest.raises(ValueError, match="`unit` is missing"):
        read_rig(path)
    read_calibration(path)
