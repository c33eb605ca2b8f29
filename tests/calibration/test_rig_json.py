"""rig.json: round trip, units, half a pixel, and what is said about wrong files."""

import json
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from poem_jax.calibration.rig_json import read_rig, write_rig
from poem_jax.geometry.transforms import invert_rigid

REAL = Path(__file__).resolve().parents[2] / "../shared/data/caliscope_4cam_hands/calibration/rig.json"


@pytest.fixture
def content(tmp_path, rig):
    return json.loads(write_rig(tmp_path / "rig.json", rig).read_text())


def rewrite(tmp_path, content):
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(content))
    return path


def test_round_trip(tmp_path, rig):
    back = read_rig(write_rig(tmp_path / "new" / "rig.json", rig))
    assert back.names == rig.names
    for got, expected in zip(back[1:], rig[1:], strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_principal_points_of_cropped_images_may_lie_anywhere(tmp_path, rig):
    rig.K[0, 0, 2] = -500
    path = write_rig(tmp_path / "rig.json", rig)
    assert json.loads(path.read_text())["cropped"] is True
    np.testing.assert_allclose(read_rig(path).K, rig.K)


def test_the_file_counts_pixels_from_a_centre(content, rig):
    K = np.array(content["cameras"][0]["K"])
    np.testing.assert_allclose(K[:2, 2] + 0.5, rig.K[0, :2, 2])
    np.testing.assert_array_equal(K[:2, :2], rig.K[0, :2, :2])


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("metre", 1.0),
        ("meters", 1.0),
        (" m ", 1.0),
        ("millimetre", 1e-3),
        ("Millimeters", 1e-3),
        ("mm", 1e-3),
        ("centimetre", 1e-2),
        ("cm", 1e-2),
    ],
)
def test_units(tmp_path, content, rig, unit, metres):
    content["unit"] = unit
    got = read_rig(rewrite(tmp_path, content)).T_cam_from_world
    np.testing.assert_allclose(got[:, :3, 3], rig.T_cam_from_world[:, :3, 3] * metres)
    np.testing.assert_allclose(got[:, :3, :3], rig.T_cam_from_world[:, :3, :3])


def test_distortion_may_be_absent_or_short(tmp_path, content):
    del content["cameras"][0]["dist"]
    content["cameras"][1]["dist"] = [0.1, -0.2, 0.0, -0.003]
    content["cameras"][2]["dist"] = [0.1, 0, 0, 0, 0.2, 0, 0, 0]
    dist = read_rig(rewrite(tmp_path, content)).dist
    np.testing.assert_array_equal(dist, [[0] * 5, [0.1, -0.2, 0.0, -0.003, 0], [0.1, 0, 0, 0, 0.2]])


@pytest.mark.parametrize(
    "terms", [[0.5, 0.1, 0, 0, 0.01, 0.6, 0.05, 0.001], [0.5, 0.1, 0, 0, 0.01, 0.6, 0.05, 0.001] + [0] * 6]
)
def test_a_rational_lens_among_others(tmp_path, content, terms):
    content["cameras"][1]["dist"] = terms
    rig = read_rig(rewrite(tmp_path, content))
    np.testing.assert_array_equal(rig.dist[1], terms[:8])
    np.testing.assert_array_equal(rig.dist[0, 5:], 0)
    np.testing.assert_array_equal(read_rig(write_rig(tmp_path / "again.json", rig)).dist, rig.dist)


@pytest.mark.parametrize("count", [12, 14])
def test_thin_prisms_and_tilted_sensors(tmp_path, content, count):
    terms = [0.5, 0.1, 1e-3, 0, 0.01, 0.6, 0.05, 0.001, 1e-3, 2e-3, -1e-3, 5e-4, 0.01, -0.02][:count]
    content["cameras"][1]["dist"] = terms
    rig = read_rig(rewrite(tmp_path, content))
    np.testing.assert_array_equal(rig.dist[1], terms)
    np.testing.assert_array_equal(read_rig(write_rig(tmp_path / "again.json", rig)).dist, rig.dist)


@pytest.mark.parametrize("key", ["distortions", "distCoef", "dist_coeffs", "distortion", "D"])
def test_lens_terms_under_the_names_of_other_tools(tmp_path, content, rig, key, caplog):
    read_rig(rewrite(tmp_path, content))
    assert not caplog.records
    for camera in content["cameras"]:
        camera[key] = camera.pop("dist")
    np.testing.assert_array_equal(read_rig(rewrite(tmp_path, content)).dist, rig.dist)
    assert f"`{key}` is read as `dist`" in caplog.text


UNREAD_LENSES = {
    "lens model": lambda c: change(c, distortion_model="double_sphere"),
    "projection": lambda c: change(c, projection="equisolid"),
    "model of the whole rig": lambda c: c.update(camera_model="FOV"),
    "apart": lambda c: change(c, dist=None, radial=[-0.3, 0.05], tangential=[0, 0]),
    "each its own key": lambda c: change(c, dist=None, k1=-0.3, k2=0.05),
    "misspelt": lambda c: change(c, dist=None, distorsion=[-0.3, 0.05, 0, 0, 0]),
    "other case": lambda c: change(c, dist=None, Dist=[-0.3, 0.05, 0, 0, 0]),
}


@pytest.mark.parametrize("case", UNREAD_LENSES)
def test_what_is_said_of_the_lens_is_never_ignored(tmp_path, content, case):
    UNREAD_LENSES[case](content)
    with pytest.raises(ValueError, match=r"says something of the lens that is not read"):
        read_rig(rewrite(tmp_path, content))


FISHEYES = {
    "of the camera": lambda c: change(c, fisheye=True),
    "of the whole rig": lambda c: c.update(fisheye=True),
    "by its model": lambda c: change(c, distortion_model="equidistant"),
    "by its projection": lambda c: change(c, projection="kannala_brandt"),
    "by the model of the whole rig": lambda c: c.update(camera_model="OPENCV_FISHEYE"),
}


@pytest.mark.parametrize("case", FISHEYES)
def test_fisheyes_have_four_terms(tmp_path, content, case):
    for camera in content["cameras"]:
        camera["dist"] = [0.05, -0.02, 0.004, -0.001]
    FISHEYES[case](content)
    rig = read_rig(rewrite(tmp_path, content))
    assert rig.fisheye[0]
    assert rig.fisheye[1] == ("whole" in case)
    np.testing.assert_array_equal(rig.dist[0, :4], [0.05, -0.02, 0.004, -0.001])
    for got, expected in zip(read_rig(write_rig(tmp_path / "again.json", rig))[1:], rig[1:], strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)
    change(content, dist=[-0.3, 0.05, 0, 0, 0.01])
    with pytest.raises(ValueError, match=r"must hold the 4 terms of a fisheye, k1 k2 k3 k4 .*; got 5"):
        read_rig(rewrite(tmp_path, content))
    change(content, dist=None)
    with pytest.raises(ValueError, match="has a fisheye, and no terms of it"):
        read_rig(rewrite(tmp_path, content))


def test_a_lens_key_that_says_nothing_new_passes(tmp_path, content, rig):
    change(content, fisheye=False, distortion_model="plumb_bob", distortions=content["cameras"][0]["dist"])
    content["camera_model"] = "pinhole"
    np.testing.assert_array_equal(read_rig(rewrite(tmp_path, content)).dist, rig.dist)
    change(content, distortions=[0.1, 0, 0, 0, 0])
    with pytest.raises(ValueError, match="`dist` and `distortions` both give the lens, and differ"):
        read_rig(rewrite(tmp_path, content))


def test_other_keys_that_hold_numbers_are_named(tmp_path, content, caplog):
    change(content, error=0.3, serial="A17", translation=[0, 0, 1])
    read_rig(rewrite(tmp_path, content))
    assert "`translation` are not read" in caplog.text
    assert "error" not in caplog.text


SPELLINGS = {
    "byte order mark": (lambda c: None, "utf-8-sig"),
    "t as a column": (lambda c: change(c, t=[[x] for x in c["cameras"][0]["t"]]), "utf-8"),
    "t as a row": (lambda c: change(c, t=[c["cameras"][0]["t"]]), "utf-8"),
    "dist as a row": (lambda c: change(c, dist=[c["cameras"][0]["dist"]]), "utf-8"),
    "dist as a column": (lambda c: change(c, dist=[[x] for x in c["cameras"][0]["dist"]]), "utf-8"),
    "no dist": (lambda c: change(c, 2, dist=[]), "utf-8"),
    "null dist": (lambda c: change(c, 2, dist=None), "utf-8"),
    "sides as floats": (lambda c: change(c, width=240.0, height=180.0), "utf-8"),
}


@pytest.mark.parametrize("case", SPELLINGS)
def test_other_spellings_are_read(tmp_path, content, rig, case):
    spell, encoding = SPELLINGS[case]
    spell(content)
    path = tmp_path / "spelt.json"
    path.write_text(json.dumps(content), encoding=encoding)
    for got, expected in zip(read_rig(path)[1:], rig[1:], strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_names_are_composed(tmp_path, content):
    change(content, name=unicodedata.normalize("NFD", "kamera_höhe"))
    path = tmp_path / "names.json"
    path.write_text(json.dumps(content, ensure_ascii=False), encoding="utf-8")
    assert read_rig(path).names[0] == "kamera_höhe"


@pytest.mark.parametrize("origin", [[50e3, 20e3, 100.0], [500e3, 4500e3, 300.0]])
def test_far_worlds(tmp_path, rig, origin):
    """Rotations of full precision serve anywhere; those of six digits do not reach a map's origin."""
    far = rig._replace(T_cam_from_world=rig.T_cam_from_world.copy())
    far.T_cam_from_world[:, :3, 3] -= rig.T_cam_from_world[:, :3, :3] @ origin
    back = read_rig(write_rig(tmp_path / "far.json", far))
    relative = [T @ invert_rigid(T[:1]) for T in (back.T_cam_from_world, rig.T_cam_from_world)]
    np.testing.assert_allclose(*relative, atol=1e-7)
    far.T_cam_from_world[:, :3, :3] = far.T_cam_from_world[:, :3, :3].round(6)
    with pytest.raises(ValueError, match=r"world's origin is .* far away.*rounding of `R`.*origin near"):
        read_rig(write_rig(tmp_path / "far.json", far))


def test_real_rig():
    if not REAL.exists():
        pytest.skip("no shared data")
    rig = read_rig(REAL)
    assert rig.names == ("cam_0", "cam_1", "cam_2", "cam_3")
    assert rig.K[0, 0, 2] == pytest.approx(618.3086297620227 + 0.5)


def change(content, camera=0, **values):
    content["cameras"][camera].update(values)


BAD = {
    "unit missing": (
        lambda c: c.pop("unit"),
        "`unit` is missing; write one of metre, centimetre, millimetre",
    ),
    "unit unknown": (lambda c: c.update(unit="foot"), "`unit` must be one of .*; got 'foot'"),
    "no cameras": (lambda c: c.update(cameras=[]), "`cameras` must be a list of at least one camera"),
    "key missing": (lambda c: c["cameras"][1].pop("R"), "camera 'front': `R` is missing; found name"),
    "camera twice": (
        lambda c: c["cameras"].append({**c["cameras"][0], "name": "copy"}),
        "cameras 'left_cam' and 'copy' are the same camera: .* list it once",
    ),
    "duplicate": (
        lambda c: change(c, 1, name="left_cam"),
        "the cameras' names must differ from each other; 'left_cam' is both number 0 and 1",
    ),
    "path": (
        lambda c: change(c, 1, name="../up"),
        "must also serve as the name of a file .*; got '../up'",
    ),
    "shear": (
        lambda c: change(c, R=[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]),
        r"`R` must be a rotation .* got det = 1, R R\^T off by 0\.1",
    ),
    "reflection": (
        lambda c: change(c, R=[[-1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        "must be a rotation .* got det = -1.*reflection, as left-handed axes",
    ),
    "rotation vector": (
        lambda c: change(c, R=[0.1, 0.2, 0.3]),
        r"`R` must have shape \(3, 3\); got \(3,\); .*rotation vector: write its matrix, cv2.Rodrigues",
    ),
    "degrees": (lambda c: change(c, R=[[90.0, 0, 45]]), "rotation vector: write its matrix"),
    "quaternion": (lambda c: change(c, R=[1, 0, 0, 0]), "quaternion: write its matrix"),
    "flat R": (lambda c: change(c, R=[1, 0, 0, 0, 1, 0, 0, 0, 1]), "nest the nine numbers as three rows"),
    "R and t in one": (
        lambda c: change(c, R=np.eye(4)[:3].tolist()),
        r"`R` must have shape \(3, 3\); got \(3, 4\); write its left three columns as `R`",
    ),
    "4 x 4 as R": (lambda c: change(c, R=np.eye(4).tolist()), r"write its upper left 3 x 3 as `R`"),
    "T transposed": (
        lambda c: change(c, T=np.eye(4).tolist(), t=np.eye(4).tolist()),
        r"`t` must have shape \(3,\); got \(4, 4\); write the top of its last column",
    ),
    "homogeneous t": (lambda c: change(c, t=[0, 0, 1, 1]), "leave out the fourth, homogeneous entry"),
    "normalised K": (
        lambda c: change(c, K=[[0.83, 0, 0.5], [0, 1.1, 0.5], [0, 0, 1]]),
        "`K` seems to be normalised: multiply its first row by the width",
    ),
    "K as four numbers": (lambda c: change(c, K=[200, 205, 118, 92]), "look like fx, fy, cx, cy"),
    "flat K": (lambda c: change(c, K=[200, 0, 118, 0, 205, 92, 0, 0, 1]), "nest the nine numbers"),
    "K scaled": (
        lambda c: change(c, K=[[400, 0, 236], [0, 410, 184], [0, 0, 2]]),
        "divide it by its last entry, 2",
    ),
    "K flipped": (
        lambda c: change(c, K=[[-200, 0, 118], [0, 205, 92], [0, 0, 1]]),
        "flip the image, not `K`",
    ),
    "other resolution": (
        lambda c: change(c, K=[[900, 0, 640], [0, 900, 360], [0, 0, 1]]),
        r"principal point \(640.0, 360.0\) must lie between 0.2 and 0.8 of the 240 x 180 image",
    ),
    "twice the resolution": (
        lambda c: change(c, K=[[410, 0, 236], [0, 410, 184], [0, 0, 1]]),
        r"principal point \(236.0, 184.0\) must lie .* \(if the images are cut out of larger ones",
    ),
    "below the diagonal": (
        lambda c: change(c, K=[[200, 0, 118], [3, 200, 92], [0, 0, 1]]),
        r"`K` must be \[\[fx, s, cx\], \[0, fy, cy\]",
    ),
    "cropped": (lambda c: c.update(cropped="yes"), "`cropped` must be true or false; got 'yes'"),
    "K transposed": (
        lambda c: change(c, K=[[9, 0, 0], [0, 9, 0], [120, 90, 1]]),
        r"`K` must be \[\[fx, s, cx\].*; it is transposed",
    ),
    "null": (lambda c: change(c, t=None), r"`t` must hold numbers of shape \(3,\); got None"),
    "null inside": (lambda c: change(c, t=[None, 0, 1]), "`t` must hold numbers"),
    "true as a number": (lambda c: change(c, t=[True, 0, 1]), "`t` must hold numbers"),
    "depths differ": (lambda c: change(c, K=[[200, 0, [118]], [0, 205, 92], [0, 0, 1]]), "`K` must hold"),
    "an object": (lambda c: change(c, R={"rows": 3}), "`R` must hold numbers"),
    "huge": (lambda c: change(c, width=10**12), "must be whole pixels, 1 to 100000; got 1000000000000"),
    "true as a side": (lambda c: change(c, width=True), "must be whole pixels"),
    "cameras as an object": (lambda c: c.update(cameras={"a": {}}), "`cameras` must be a list"),
    "unit as a number": (lambda c: c.update(unit=1000), "`unit` must be one of .*; got 1000"),
    "units": (lambda c: c.update(units=c.pop("unit")), "`unit` is missing; .*found .*units"),
    "NaN": (lambda c: change(c, t=[0, float("nan"), 1]), "`t` must be finite"),
    "shape": (lambda c: change(c, t=[0, 1]), r"`t` must have shape \(3,\); got \(2,\)"),
    "text": (lambda c: change(c, t=["a", "b", "c"]), "`t` must hold numbers"),
    "size": (lambda c: change(c, width=240.5), "whole pixels, 1 to 100000; got 240.5 x 180"),
    "two lens terms": (
        lambda c: change(c, dist=[0.1] * 2),
        r"`dist` must hold 4, 5, 8, 12 or 14 terms.*; got 2",
    ),
    "lens as an object": (lambda c: change(c, dist={"k1": 0.1}), "`dist` must be a list k1 k2 p1 p2 k3"),
    "lens as text": (lambda c: change(c, dist="none"), "`dist` must hold numbers"),
}


@pytest.mark.parametrize("case", BAD)
def test_wrong_content_is_named(tmp_path, content, case):
    spoil, message = BAD[case]
    spoil(content)
    with pytest.raises(ValueError, match=message):
        read_rig(rewrite(tmp_path, content))


def test_wrong_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="no rig file at"):
        read_rig(tmp_path / "none.json")
    (tmp_path / "text.json").write_text("cameras: 4")
    with pytest.raises(ValueError, match=r"text.json cannot be read as JSON"):
        read_rig(tmp_path / "text.json")
    (tmp_path / "twice.json").write_text('{"unit": "metre", "unit": "millimetre", "cameras": []}')
    with pytest.raises(ValueError, match="the key `unit` comes more than once"):
        read_rig(tmp_path / "twice.json")
    (tmp_path / "list.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match="must hold a JSON object"):
        read_rig(tmp_path / "list.json")


def test_the_reader_keeps_the_name_that_scripts_import():
    from poem_jax.capture import rig_file

    assert rig_file.read_rig is read_rig
