"""Real calibrations: one rig as six tools write it, and what public projects have."""

import shutil

import cv2
import numpy as np
import pytest

from poem_jax.calibration.read_calibration import read_calibration
from tests.calibration.rigs_of_all_lenses import seen_by, some_points

SIX = (
    "rig.json",
    "anipose.toml",
    "caliscope_config.toml",
    "opencv_rig.yml",
    "easymocap",
    "easymocap/extri.yml",
    "colmap",
    "colmap/cameras.txt",
    "transforms.json",
)


@pytest.mark.parametrize("name", SIX)
@pytest.mark.parametrize("capture", ["caliscope_4cam_hands", "caliscope_4cam_board"])
def test_one_rig_in_every_format_images_a_point_at_one_pixel(shared_dir, capture, name):
    """Against OpenCV itself, with the numbers of the key points' file."""
    folder = shared_dir / "data" / capture
    rig = read_calibration(folder / "calibration" / name)
    with np.load(folder / "pseudo_gt.npz") as stored:
        points = some_points()
        for view in range(4):
            rvec = cv2.Rodrigues(stored["R_world2cam"][view])[0]
            expected, _ = cv2.projectPoints(
                points, rvec, stored["t_world2cam"][view], stored["K"][view], stored["dist"][view]
            )
            in_front = (rig.T_cam_from_world[view] @ np.pad(points, ((0, 0), (0, 1)), constant_values=1).T)[
                2
            ] > 0.1
            got = seen_by(rig, points)[view] - 0.5
            np.testing.assert_allclose(got[in_front], expected[in_front, 0], rtol=0, atol=1e-6)
        np.testing.assert_array_equal(rig.size_wh, np.broadcast_to(stored["image_size_wh"], (4, 2)))
    assert rig.names == ("cam_0", "cam_1", "cam_2", "cam_3")


READ = {
    "calib_formats/cmu_panoptic_calibration.json": (8, "00_00", {}),
    "calib_formats/instant_ngp_transforms.json": (6, "0001", {}),
    "calib_formats/opencv_stereo_intrinsics.yml": (2, "cam_1", {"image_size": (1344, 750), "unit": "cm"}),
    "calib_formats/opencv_stereo_extrinsics.yml": (2, "cam_1", {"image_size": (1344, 750), "unit": "cm"}),
    "calib_formats/openpose_flir_17012332.xml": (
        1,
        "openpose_flir_17012332",
        {"image_size": (1280, 1024)},
    ),
    "calib_formats/voxelpose_calibration_shelf.json": (5, "0", {"image_size": (1032, 776)}),
    "caliscope_4cam_track/caliscope_config.toml": (4, "cam_0", {}),
    "assemblyhands_calib/nusar-2021_action_both_9012-c07c_9012_user_id_2021-02-01_164345.json": (
        8,
        "C10095_rgb",
        {},
    ),
    "assemblyhands_calib/nusar-2021_action_both_9053-c08b_9053_user_id_2021-02-08_140757.json": (
        8,
        "C10119_rgb",
        {},
    ),
    "handpose3d_2cam/calibration": (2, "c0", {"image_size": (720, 720), "unit": 0.046}),
    "handpose3d_2cam/calibration/rot_trans_c1.dat": (2, "c0", {"image_size": (720, 720), "unit": 0.046}),
}
REFUSED = {
    "calib_formats/anipose_calibration.toml": "cameras 'side' and 'top' are the same camera",
    "calib_formats/colmap_cameras.txt": r"images\.txt, where the cameras stand, is missing",
    "calib_formats/colmap_cameras_simple_pinhole.txt": r"images\.txt, where the cameras stand, is missing",
    "calib_formats/ros_camera_info_camera0.yaml": "a ROS camera_info: it holds the lens of one camera alone",
    "calib_formats/openpose_flir_17012332.xml": "does not hold the size of the images",
    "dexycb_calib/rig_20200820.json": "`name` is missing; found serial",
    "calib_formats": r"holds \d+ calibrations: ",
    "handpose3d_2cam/calibration": "does not hold the size of the images",
}


@pytest.mark.parametrize("name", READ)
def test_public_samples_are_read(shared_dir, name):
    cameras, first, given = READ[name]
    rig = read_calibration(shared_dir / "data" / name, **given)
    assert (rig.num_views, rig.names[0]) == (cameras, first)
    centres = -np.einsum("vji,vj->vi", rig.T_cam_from_world[:, :3, :3], rig.T_cam_from_world[:, :3, 3])
    assert np.linalg.norm(centres - centres[0], axis=-1).max() < 20


@pytest.mark.parametrize("name", REFUSED)
def test_public_samples_that_make_no_rig_say_why(shared_dir, name):
    with pytest.raises(ValueError, match=REFUSED[name]):
        read_calibration(shared_dir / "data" / name)


def test_every_public_sample_is_in_one_of_the_lists(shared_dir):
    listed = {name.split("/")[-1] for name in (*READ, *REFUSED)}
    assert {path.name for path in (shared_dir / "data" / "calib_formats").iterdir()} <= listed


def test_the_hand_pose_rig_agrees_with_its_key_points(shared_dir):
    folder = shared_dir / "data" / "handpose3d_2cam"
    rig = read_calibration(folder / "calibration", image_size=(720, 720), unit=1.0)
    with np.load(folder / "pseudo_gt.npz") as stored:
        points = stored["joints_3d_world"][0]
        expected = stored["keypoints_2d"][0]
    assert np.nanmedian(np.linalg.norm(seen_by(rig, points) - 0.5 - expected, axis=-1)) < 4


def test_panoptic_is_in_centimetres(shared_dir):
    rig = read_calibration(shared_dir / "data" / "calib_formats" / "cmu_panoptic_calibration.json")
    R, t = rig.T_cam_from_world[0, :3, :3], rig.T_cam_from_world[0, :3, 3]
    np.testing.assert_allclose(t, [0.2090028135, 1.272202879, 2.831159034])
    assert 2 < np.linalg.norm(-R.T @ t) < 5


def test_a_capture_finds_the_calibration_of_another_tool(shared_dir, tmp_path):
    from poem_jax.data.capture_folder import find_rig

    source = shared_dir / "data" / "caliscope_4cam_hands" / "calibration"
    shutil.copytree(source / "colmap", tmp_path / "calibration")
    expected = read_calibration(source / "rig.json")
    np.testing.assert_allclose(find_rig(tmp_path).K, expected.K, atol=1e-9)
    shutil.copy(source / "anipose.toml", tmp_path / "anipose.toml")
    with pytest.raises(
        ValueError, match=r"several calibrations, anipose\.toml, calibration.*: say which by --rig"
    ):
        find_rig(tmp_path)
    np.testing.assert_allclose(find_rig(tmp_path, tmp_path / "calibration").K, expected.K, atol=1e-9)
    shutil.copy(source / "rig.json", tmp_path / "rig.json")
    np.testing.assert_allclose(find_rig(tmp_path).K, expected.K)
