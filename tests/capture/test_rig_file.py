"""rig.json: round trip, units, half a pixel, and what is said about wrong files."""

import json
from pathlib import Path

import numpy as np
import pytest

from poem_jax.capture.rig_file import read_rig, write_rig

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
    [("metre", 1.0), ("meter", 1.0), ("millimetre", 1e-3), ("mm", 1e-3), ("centimetre", 1e-2)],
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
    "unit unknown": (lambda c: c.update(unit="inch"), "`unit` must be one of .*; got 'inch'"),
    "no cameras": (lambda c: c.update(cameras=[]), "`cameras` must be a list of at least one camera"),
    "key missing": (lambda c: c["cameras"][1].pop("R"), "camera 'front': `R` is missing; found name"),
    "duplicate": (
        lambda c: change(c, 1, name="left_cam"),
        "names must differ; 'left_cam' comes more than once",
    ),
    "path": (lambda c: change(c, 1, name="../up"), "must also serve as a file name; got '../up'"),
    "shear": (
        lambda c: change(c, R=[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]),
        r"`R` must be a rotation .* got det = 1, R R\^T off by 0\.1",
    ),
    "reflection": (
        lambda c: change(c, R=[[-1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        "must be a rotation .* got det = -1",
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
    "not K": (lambda c: change(c, K=[[9, 0, 0], [0, 9, 0], [120, 90, 1]]), r"`K` must be \[\[fx, s, cx\]"),
    "NaN": (lambda c: change(c, t=[0, float("nan"), 1]), "`t` must be finite"),
    "shape": (lambda c: change(c, t=[0, 1]), r"`t` must have shape \(3,\); got \(2,\)"),
    "text": (lambda c: change(c, t=["a", "b", "c"]), "`t` must hold numbers"),
    "size": (lambda c: change(c, width=240.5), "width and height must be whole pixels; got 240.5 x 180"),
    "distortion": (lambda c: change(c, dist=[0.1] * 8), r"`dist` must have shape \(5,\); got \(8,\)"),
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
    with pytest.raises(ValueError, match=r"must be a rig in JSON; it cannot be parsed"):
        read_rig(tmp_path / "text.json")
    (tmp_path / "list.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match="must hold a JSON object"):
        read_rig(tmp_path / "list.json")
