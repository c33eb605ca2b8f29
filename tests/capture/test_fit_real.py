"""`poem fit` on real captures: 2D detections on real hands, and rigs that are not what they should be.

The stored 3D joints are triangulated detections, right to 5 to 10 mm, not ground truth.
"""

import logging
from pathlib import Path

import numpy as np
import pytest

from poem_jax.calibration.rig_json import read_rig, write_rig
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints, write_boxes
from poem_jax.capture.detect import detect_hands
from poem_jax.capture.pipeline import fit
from poem_jax.capture.take import read_keypoint_take
from poem_jax.data.capture_folder import find_frames
from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.geometry.transforms import rigid

SIDES = ("right", "left")

pytestmark = pytest.mark.parity


@pytest.fixture
def data(shared_dir) -> Path:
    return shared_dir / "data"


def tracks(stored) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Sort single hands into (frame, side, ...): key points, joints and the names of the frames."""
    frames = sorted(set(stored["frame"].tolist()))
    views = stored["keypoints_2d"].shape[1]
    keypoints = np.full((len(frames), 2, views, 21, 2), np.nan)
    joints = np.full((len(frames), 2, 21, 3), np.nan)
    for index, (frame, side) in enumerate(zip(stored["frame"], stored["hand_side"], strict=True)):
        place = frames.index(frame), SIDES.index(str(side))
        keypoints[place], joints[place] = stored["keypoints_2d"][index], stored["joints_3d_world"][index]
    return keypoints + HALF_PIXEL, joints, tuple(map(str, frames))


def rig_of(stored) -> Rig:
    K = stored["K"].astype(np.float64)
    K[:, :2, 2] += HALF_PIXEL
    T = rigid(stored["R_world2cam"], stored["t_world2cam"].reshape(-1, 3))
    names = tuple(f"cam_{view}" for view in range(len(K)))
    return Rig(names, stored["image_size_wh"].astype(int), K, stored["dist"].astype(np.float64), T)


def as_file(folder: Path, keypoints: np.ndarray, sides, frames=None) -> Path:
    return write_boxes(
        folder / "keypoints.npz", HandBoxes(boxes_from_keypoints(keypoints), sides, frames, keypoints)
    )


@pytest.mark.parametrize(
    ("folder", "most_mm", "most_px"), [("caliscope_4cam_hands", 8, 6), ("caliscope_4cam_board", 12, 6)]
)
def test_both_hands_of_a_real_capture(data, tmp_path, caplog, folder, most_mm, most_px):
    stored = np.load(data / folder / "pseudo_gt.npz")
    keypoints, joints, frames = tracks(stored)
    rig = data / folder / "calibration" / "rig.json"
    take = read_keypoint_take(as_file(tmp_path, keypoints, SIDES, frames), rig, data / folder)
    with caplog.at_level(logging.WARNING):
        written = fit(take, tmp_path / "out", progress=False)
    assert written.arrays["valid"].all()
    distance = 1000 * np.linalg.norm(written.arrays["joints_world"] - joints, axis=-1)
    print(f"{np.nanmedian(distance):.2f} mm, {np.nanmedian(written.arrays['reprojection_px']):.2f} px")
    assert np.nanmedian(distance) <= most_mm
    assert np.nanmedian(written.arrays["reprojection_px"]) <= most_px
    assert written.report["warnings"] == []
    overlays = list((tmp_path / "out").glob("*/overlay_*.png"))
    assert len(overlays) == len(frames) * take.rig.num_views


def test_a_rig_that_is_not_metric_is_refused(data, tmp_path):
    """One unit of this rig is about 46 mm."""
    stored = np.load(data / "handpose3d_2cam" / "pseudo_gt.npz")
    keypoints = stored["keypoints_2d"][:, None] + HALF_PIXEL
    rig = write_rig(tmp_path / "rig.json", rig_of(stored))
    take = read_keypoint_take(as_file(tmp_path, keypoints, ("right",)), rig)
    with pytest.raises(ValueError, match=r"not metres.*one unit of the rig is about 4[4-9] mm"):
        fit(take, tmp_path / "out", progress=False)


def test_inconsistent_cameras_are_named(data, tmp_path):
    """Cameras 0 and 2 of this rig disagree by 25 px; 46 of its 356 hands are seen by too few views."""
    stored = np.load(data / "caliscope_4cam_track" / "hands_track.npz")
    keypoints = np.moveaxis(stored["keypoints_2d"].astype(float), 2, 1) + HALF_PIXEL
    sides = tuple(str(side) for side in stored["hand_order"])
    rig = write_rig(tmp_path / "rig.json", rig_of(stored))
    written = fit(
        read_keypoint_take(as_file(tmp_path, keypoints, sides), rig), tmp_path / "out", progress=False
    )
    (said,) = [text for text in written.report["warnings"] if "do not fit together" in text]
    assert "'cam_0' and 'cam_2'" in said
    assert written.arrays["valid"].any()
    assert np.isfinite(written.arrays["joints_world"][written.arrays["valid"]]).all()


@pytest.mark.parametrize(
    ("folder", "most_mm"), [("caliscope_4cam_hands", 1.0), ("caliscope_4cam_board", 1.5)]
)
def test_images_alone_give_the_same_hands(data, tmp_path, folder, most_mm):
    """Detection and association, then the fit, against the fit to the stored key points."""
    stored = np.load(data / folder / "pseudo_gt.npz")
    keypoints, _, frames = tracks(stored)
    found_rig = read_rig(data / folder / "calibration" / "rig.json")
    hands = detect_hands(find_frames(data / folder, found_rig.names), found_rig, progress=False)
    assert hands.frames is not None
    assert hands.hand_side == SIDES
    assert (np.isfinite(hands.boxes_px).all(-1).sum(-1) >= 2).all()
    order = [hands.frames.index(name) for name in sorted(hands.frames)]
    assert [int(hands.frames[index]) for index in order] == [int(frame) for frame in frames]
    results = [
        fit(
            read_keypoint_take(as_file(tmp_path, points, SIDES), data / folder / "calibration" / "rig.json"),
            tmp_path / "out",
            progress=False,
        )
        for points in (keypoints, hands.keypoints_px[order])
    ]
    assert all(result.arrays["valid"].all() for result in results)
    one, other = (result.arrays["joints_world"] for result in results)
    apart = 1000 * np.median(np.linalg.norm(one - other, axis=-1))
    print(f"{apart:.2f} mm apart")
    assert apart <= most_mm
