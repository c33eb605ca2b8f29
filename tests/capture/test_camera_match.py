"""Which file is of which camera."""

import unicodedata
from pathlib import Path

import pytest

from poem_jax.capture.camera_match import cameras_of, match_cameras


@pytest.mark.parametrize(
    ("name", "cameras", "expected"),
    [
        ("cam_0", ("cam_0", "cam_1"), ["cam_0"]),
        ("CAM_0", ("cam_0", "cam_1"), ["cam_0"]),
        ("cam0_take 2", ("cam_0", "cam_2"), ["cam_0"]),
        ("take 2 cam-01", ("cam_0", "cam_1", "cam_2"), ["cam_1"]),
        ("cam_10", ("cam_1", "cam_10"), ["cam_10"]),
        ("cam_10_a", ("cam_1", "cam_10"), ["cam_10"]),
        ("cam_100", ("cam_1", "cam_10"), []),
        ("left hand front", ("left", "front"), ["left", "front"]),
        ("front left", ("front", "front_left"), ["front_left"]),
        ("Front", ("front", "Front"), ["Front"]),
        (unicodedata.normalize("NFD", "HÖHE"), ("höhe", "x"), ["höhe"]),
        ("video", ("cam_0",), []),
    ],
)
def test_names(name, cameras, expected):
    assert cameras_of(name, cameras) == expected


def test_every_file_has_one_camera():
    cameras = ("cam_0", "cam_1")
    paths = [Path("cam_0.mp4"), Path("cam_1 take.mp4")]
    assert match_cameras(paths, cameras, "videos") == dict(zip(cameras, paths, strict=True))
    with pytest.raises(
        ValueError, match=r"x\.mp4 is of no camera of the rig; the videos are x\.mp4, the rig's"
    ):
        match_cameras([Path("x.mp4")], cameras, "videos")
    with pytest.raises(ValueError, match=r"cam_0 cam_1\.mp4 may be of any of cam_0, cam_1"):
        match_cameras([Path("cam_0 cam_1.mp4")], cameras, "videos")
    with pytest.raises(ValueError, match=r"cam_0\.mp4 and cam_0\.mov are both of camera 'cam_0'"):
        match_cameras([Path("cam_0.mp4"), Path("cam_0.mov")], cameras, "videos")
