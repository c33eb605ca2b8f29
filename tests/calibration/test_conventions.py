"""What each format means, by files written out here: direction of the extrinsics, unit, origin of pixels."""

import json

import numpy as np
import pytest

from poem_jax.calibration.read_calibration import read_calibration

QUARTER = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""x_cam = R x_world: a quarter of a turn about the axis; its vector is (0, 0, -pi/2)."""
T_METRES = np.array([0.1, -0.2, 0.9])
CENTRE = -QUARTER.T @ T_METRES
K_CENTRES = [[900.0, 0, 640], [0, 910, 360], [0, 0, 1]]
TERMS = [-0.3, 0.1, 0.001, -0.002, 0.02]


def opencv_matrix(values):
    array = np.atleast_2d(values)
    data = ", ".join(map(str, array.ravel().tolist()))
    rows, cols = array.shape
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]"


def panoptic(folder):
    camera = {"name": "a", "type": "hd", "resolution": [1280, 720], "K": K_CENTRES, "distCoef": TERMS}
    camera |= {"R": QUARTER.tolist(), "t": (100 * T_METRES[:, None]).tolist()}
    panel = {**camera, "name": "p", "type": "vga"}
    (folder / "a.json").write_text(json.dumps({"cameras": [camera, panel]}))


def voxelpose(folder):
    camera = {"fx": 900, "fy": 910, "cx": 640, "cy": 360, "R": QUARTER.tolist(), "width": 1280, "height": 720}
    k1, k2, p1, p2, k3 = TERMS
    camera |= {"T": (1000 * CENTRE[:, None]).tolist(), "k": [[k1], [k2], [k3]], "p": [[p1], [p2]]}
    (folder / "a.json").write_text(json.dumps({"a": camera}))


def openpose(folder):
    T = np.concatenate([QUARTER, T_METRES[:, None]], -1)
    parts = {
        "CameraMatrix": T,
        "Intrinsics": np.array(K_CENTRES),
        "Distortion": np.array([*TERMS, 0, 0, 0])[:, None],
    }
    body = "".join(
        f'<{name} type_id="opencv-matrix"><rows>{m.shape[0]}</rows><cols>{m.shape[1]}</cols><dt>d</dt>'
        f"<data>{' '.join(map(str, m.ravel()))}</data></{name}>"
        for name, m in parts.items()
    )
    size = "<ImageWidth>1280</ImageWidth><ImageHeight>720</ImageHeight>"
    (folder / "a.xml").write_text(f'<?xml version="1.0"?><opencv_storage>{body}{size}</opencv_storage>')


def easymocap(folder):
    head = "%YAML:1.0\n---\nnames:\n  - a\n"
    intri = f"K_a: {opencv_matrix(K_CENTRES)}\ndist_a: {opencv_matrix(TERMS)}\nH_a: 720\nW_a: 1280\n"
    extri = f"R_a: {opencv_matrix([0, 0, -np.pi / 2])}\nT_a: {opencv_matrix(T_METRES)}\n"
    (folder / "intri.yml").write_text(head + intri)
    (folder / "extri.yml").write_text(head + extri)


def freemocap(folder):
    text = f"""[cam_0]
name = "a"
size = [ 1280, 720,]
matrix = {K_CENTRES}
distortions = {TERMS}
rotation = {[0.0, 0.0, -np.pi / 2]}
translation = {(1000 * T_METRES).tolist()}

[metadata]
charuco_square_size = 39.0
path_to_recorded_videos = "x"
"""
    (folder / "a.toml").write_text(text)


def newer_caliscope(folder):
    text = f"""[cameras.0]
cam_id = 0
name = "a"
size = [1280, 720]
rotation_count = 0
matrix = {K_CENTRES}
distortions = {TERMS}
rotation = {[0.0, 0.0, -np.pi / 2]}
translation = {T_METRES.tolist()}
fisheye = false
"""
    (folder / "a.toml").write_text(text)


def stereo_dat(folder):
    rows = "\n".join(" ".join(map(str, row)) for row in K_CENTRES)
    (folder / "a.dat").write_text(f"intrinsic:\n{rows}\ndistortion:\n{' '.join(map(str, TERMS))}\n")
    R = "\n".join(" ".join(map(str, row)) for row in QUARTER)
    t = "\n".join(map(str, 100 * T_METRES))
    (folder / "rot_trans_a.dat").write_text(f"R:\n{R}\nT:\n{t}\n\n#another\nR:\n1 2 3\n")


def nerfstudio(folder):
    world_from_opengl = np.eye(4)
    world_from_opengl[:3, :3] = QUARTER.T @ np.diag([1, -1, -1])
    world_from_opengl[:3, 3] = CENTRE
    lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), TERMS, strict=True))
    shared = {"w": 1280, "h": 720, "fl_x": 900, "fl_y": 910, "cx": 640.5, "cy": 360.5, **lens}
    frame = {"file_path": "./images/a.png", "transform_matrix": world_from_opengl.tolist()}
    (folder / "a.json").write_text(json.dumps({**shared, "frames": [frame]}))


def colmap(folder):
    half = np.sqrt(0.5)
    place = f"{half} 0 0 {-half} {' '.join(map(str, T_METRES))}"
    (folder / "images.txt").write_text(f"7 {place} 3 a.jpg\n1.5 2.5 -1 4 5 88\n")
    terms = " ".join(map(str, [*TERMS, 0, 0, 0]))
    (folder / "cameras.txt").write_text(f"3 FULL_OPENCV 1280 720 900 910 640.5 360.5 {terms}\n")


@pytest.mark.parametrize(
    "write",
    [
        panoptic,
        voxelpose,
        openpose,
        easymocap,
        freemocap,
        newer_caliscope,
        stereo_dat,
        nerfstudio,
        colmap,
    ],
)
def test_one_camera_in_the_words_of_each_tool(tmp_path, write):
    write(tmp_path)
    size = (1280, 720) if write is stereo_dat else None
    rig = read_calibration(tmp_path, image_size=size)
    assert rig.names == ("a",)
    np.testing.assert_allclose(rig.T_cam_from_world[0, :3, :3], QUARTER, atol=1e-9)
    np.testing.assert_allclose(rig.T_cam_from_world[0, :3, 3], T_METRES, atol=1e-9)
    np.testing.assert_allclose(rig.K[0], np.add(K_CENTRES, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
    np.testing.assert_allclose(rig.dist[0], TERMS)
    np.testing.assert_array_equal(rig.size_wh, [[1280, 720]])


def test_the_chain_of_kalibr(tmp_path):
    """The third camera's place is that by the second, times that of the second by the first."""
    camera = """  camera_model: pinhole
  distortion_coeffs: [-0.3, 0.1, 0.001, -0.002]
  distortion_model: {model}
  intrinsics: [900.0, 910.0, 640.0, 360.0]
  resolution: [1280, 720]
  rostopic: /cam{i}/image_raw
"""
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = QUARTER, T_METRES
    text = "".join(
        f"cam{i}:\n{camera.format(model=('radtan', 'equidistant')[i % 2], i=i)}"
        + (f"  T_cn_cnm1: {step.tolist()}\n" if i else "")
        for i in range(3)
    )
    (tmp_path / "camchain.yaml").write_text(text)
    rig = read_calibration(tmp_path / "camchain.yaml")
    np.testing.assert_allclose(rig.T_cam_from_world, [np.eye(4), step, step @ step], atol=1e-12)
    np.testing.assert_array_equal(rig.fisheye, [False, True, False])
    np.testing.assert_allclose(rig.dist[:, :4], [[-0.3, 0.1, 0.001, -0.002]] * 3)
    np.testing.assert_allclose(rig.K[:, :2, 2], [[640.5, 360.5]] * 3)


def test_a_pair_of_opencv_s_stereo_sample(tmp_path):
    lens = "".join(f"M{i}: {opencv_matrix(K_CENTRES)}\nD{i}: {opencv_matrix(TERMS)}\n" for i in (1, 2))
    (tmp_path / "intrinsics.yml").write_text(f"%YAML:1.0\n---\n{lens}")
    place = f"R: {opencv_matrix(QUARTER)}\nT: {opencv_matrix(T_METRES[:, None])}\n"
    (tmp_path / "extrinsics.yml").write_text(f"%YAML:1.0\n---\n{place}")
    rig = read_calibration(tmp_path, image_size=(1280, 720))
    assert rig.names == ("cam_1", "cam_2")
    np.testing.assert_array_equal(rig.T_cam_from_world[0], np.eye(4))
    np.testing.assert_allclose(rig.T_cam_from_world[1, :3, 3], T_METRES)
    np.testing.assert_allclose(rig.T_cam_from_world[1, :3, :3], QUARTER)
