"""Faults planted into good calibrations are named, each by its own name; good ones raise no alarm.

Three good rigs: two real ones of four cameras (skipped without the reference material) and a drawn one.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.calibration.read_calibration import read_calibration
from poem_jax.calibration.units import farthest_pair
from poem_jax.calibration.write_calibration import write_calibration
from poem_jax.capture.calibration_check import check_calibration
from poem_jax.geometry.cameras import project
from poem_jax.geometry.distortion import distort_pixels
from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.keypoint_takes import IMAGE_WH, draw_keypoint_take
from tests.calibration.planted_faults import FAULTS, words

NOISE_PX = 0.8
FRAMES = 24


def moving_take(tau_frames=(0.0, 0.0, 0.0, 0.0), seed=3, frames=FRAMES, noise_px=NOISE_PX):
    """A rig, and raw key points of a hand on a smooth way, each camera `tau` frames late."""
    drawn = draw_keypoint_take(default_hand(), 1, 4, 0.0, seed)
    rng = np.random.default_rng(seed)
    K = drawn.K.astype(float) * np.array([1.0, 0.93, 1.0])[:, None] + [[0, 0, 9.0], [0, 0, -14], [0, 0, 0]]
    dist = np.tile([-0.25, 0.06, 1e-3, -1e-3, 0.0], (4, 1))
    names = ("left", "front", "right", "above")
    T = drawn.T_cam_from_world.astype(float)
    T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    rig = Rig(names, np.tile(IMAGE_WH, (4, 1)), K, dist, T)
    hand = drawn.joints[0] - drawn.joints[0].mean(0)
    uv = np.empty((frames, 1, 4, 21, 2))
    for view, tau in enumerate(tau_frames):
        t = (np.arange(frames) + tau)[:, None]
        place = 0.2 * np.sin(t * [0.31, 0.23, 0.41] + [0, 1, 2])
        R = rotation_from_axis_angle(0.6 * np.sin(t * [0.2, 0.13, 0.17]))
        joints = np.einsum("fij,pj->fpi", R, hand) + place[:, None]
        ideal, _ = project(rig.K[view], rig.T_cam_from_world[view], joints)
        uv[:, 0, view] = distort_pixels(ideal, rig.K[view], rig.dist[view])
    return rig, uv + rng.normal(0, noise_px, uv.shape)


def rig_of(stored):
    """The rig of a pseudo ground truth, with the house's pixels."""
    count = len(stored["K"])
    K = stored["K"].astype(float)
    K[:, :2, 2] += HALF_PIXEL
    T = rigid(stored["R_world2cam"].astype(float), stored["t_world2cam"].astype(float).reshape(count, 3))
    size = np.broadcast_to(stored["image_size_wh"], (count, 2)).astype(int)
    return Rig(tuple(f"cam_{i}" for i in range(count)), size, K, stored["dist"].astype(float), T)


def real_take(folder):
    """A rig and its key points, (frame, hand, view, 21, 2), hands left before right."""
    stored = np.load(folder / "pseudo_gt.npz")
    frames, sides = np.unique(stored["frame"]), ("left", "right")
    uv = np.full((len(frames), 2, stored["keypoints_2d"].shape[1], 21, 2), np.nan)
    for frame, side, points in zip(stored["frame"], stored["hand_side"], stored["keypoints_2d"], strict=True):
        uv[np.flatnonzero(frames == frame)[0], sides.index(str(side))] = points + HALF_PIXEL
    return rig_of(stored), uv


REAL = ("caliscope_4cam_hands", "caliscope_4cam_board")


@pytest.fixture(scope="module")
def take():
    return moving_take()


@pytest.fixture(scope="module", params=REAL)
def real(request, shared_dir):
    return request.param, *real_take(shared_dir / "data" / request.param)


def expect(fault, rig, uv):
    plant, name, text = FAULTS[fault]
    found = check_calibration(*plant(rig, uv))
    assert [finding.name for finding in found][:1] == [name], [str(finding) for finding in found]
    assert words(text, rig) in str(found[0])
    assert found[0].fix


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_a_drawn_rig_are_named(fault, take):
    expect(fault, *take)


def test_a_good_rig_raises_no_alarm(take):
    rig, uv = take
    assert check_calibration(rig, uv) == []
    assert check_calibration(rig) == []


def test_faults_that_a_rig_shows_by_itself(take):
    """As doubts, without key points; a rig read as it was written has none."""
    rig, _ = take
    expected = {
        "OpenGL axes": "cameras look apart",
        "millimetres": "unit of the rig",
        "duplicate cameras": "duplicate cameras",
    }
    for fault, name in expected.items():
        spoiled, _ = FAULTS[fault][0](rig, np.zeros((1, 1, 4, 21, 2)))
        assert name in [finding.name for finding in check_calibration(spoiled)], fault


def test_images_that_are_cut_out_of_larger_ones_raise_no_alarm(take):
    rig, _ = take
    K = rig.K.copy()
    K[1, 0, 2] -= 0.6 * rig.size_wh[1, 0]
    assert check_calibration(rig._replace(K=K)) == []


@pytest.mark.parametrize(("extent_m", "alarms"), [(0.025, 1), (0.035, 0), (19.5, 0), (20.5, 1)])
def test_a_rig_that_is_read_without_a_doubt_of_its_unit_raises_none(tmp_path, take, extent_m, alarms):
    rig, _ = take
    T = rig.T_cam_from_world.copy()
    T[:, :3, 3] *= extent_m / farthest_pair(T)
    rig = rig._replace(T_cam_from_world=T)
    assert [finding.name for finding in check_calibration(rig)] == ["unit of the rig"] * alarms
    path = write_calibration(tmp_path, rig, "colmap")
    if alarms:
        with pytest.raises(ValueError, match="--unit UNIT"):
            read_calibration(path)
    else:
        assert read_calibration(path).names == rig.names


@pytest.mark.parametrize("tau", [0.4, -0.7, 2.5])
def test_parts_of_a_frame_are_told(tau):
    rig, uv = moving_take((0.0, tau, 0.0, 0.0))
    (found,) = check_calibration(rig, uv, np.arange(FRAMES) / 25)
    assert found.name == "time offset"
    told = float(str(found).split("'front' ")[1].split(" frames")[0])
    assert abs(told - tau) < 0.1
    told_ms = float(str(found).split(" frames (")[1].split(" ms)")[0])
    assert abs(told_ms - 40 * told) <= 1, "25 frames a second"


def test_offsets_of_several_cameras_are_told():
    rig, uv = moving_take((0.0, 1.3, 0.0, -0.8))
    (found,) = check_calibration(rig, uv)
    assert found.name == "time offset"
    assert "'front' +1." in str(found)
    assert "'above' -0." in str(found)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_real_rigs_are_named(fault, real):
    _, rig, uv = real
    expect(fault, rig, uv)


def test_good_real_rigs_raise_no_alarm(real):
    _, rig, uv = real
    assert check_calibration(rig, uv) == []
    assert check_calibration(rig) == []


def test_the_bad_track_is_flagged(shared_dir):
    folder = shared_dir / "data" / "caliscope_4cam_track"
    stored = np.load(next(folder.glob("*.npz")))
    uv = np.moveaxis(stored["keypoints_2d"].astype(float), 1, 2) + HALF_PIXEL
    found = check_calibration(rig_of(stored), uv)
    assert found
