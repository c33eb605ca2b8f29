"""Readers find in every miniature the hands that were planted there: to 1e-5 m and 0.01 pixels.

Readers and miniatures were written apart from DATASETS and the sets' public documentation.
"""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from poem_jax.data.frames import FrameSource, MultiViewFrame
from poem_jax.data.sources.arctic import Arctic
from poem_jax.data.sources.dexycb import DexYCB
from poem_jax.data.sources.freihand import FreiHAND
from poem_jax.data.sources.ho3d import HO3D
from poem_jax.data.sources.interhand import InterHand
from poem_jax.data.sources.oakink import OakInk
from poem_jax.data.sources.released_tars import ReleasedTars
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.miniatures.names import WRITERS
from poem_jax.miniatures.scene import PlantedFrame, take_views

METRES, PIXELS = 1e-5, 0.01
UNPLANTED = {"freihand": 3}
"""Frames that are read besides: the training hand before three other backgrounds."""


def raw_sources(name: str, root: Path, mano: Path) -> list[FrameSource]:
    """Open every split."""
    match name:
        case "dexycb":
            return [DexYCB(root, split=split, mano=mano) for split in ("train", "val", "test")]
        case "ho3d-v2" | "ho3d-v3":
            version = name.removeprefix("ho3d-")
            splits = ("train", "test", "evaluation-mv")
            return [HO3D(root, split=split, version=version, mano=mano) for split in splits]
        case "oakink":
            return [OakInk(root, split=split, mano=mano) for split in ("train+val", "test")]
        case "arctic":
            return [Arctic(root, split=split, mano=mano) for split in ("train", "val")]
        case "interhand":
            return [InterHand(root, split=split, mano=mano) for split in ("train", "val", "test")]
        case "freihand":
            return [FreiHAND(root, split=split, backgrounds=4, mano=mano) for split in ("train", "test")]
    return [ReleasedTars(path, mano=mano) for path in archives(root)]


def archives(root: Path) -> list[Path]:
    return sorted(root.rglob("*.tar"))


@pytest.fixture(params=WRITERS)
def both(request, miniature, mano_file):
    """What was planted, and what is read."""
    name = request.param
    written = miniature(name)
    sources = raw_sources(name, written.root, mano_file)
    read = [source[i] for source in sources for i in range(len(source))]
    # Two views of SB1 are in the evaluation set as well as in the test.
    read = [frame for frame in read if frame.view_names != ("1", "3")]
    assert len(read) == len(written.planted) + UNPLANTED.get(name, 0)
    return written.planted, read


def test_every_planted_frame_is_found_and_no_other(both):
    planted, read = both
    pairs = [(frame, nearest(frame, read)) for frame in planted]
    assert len({found.key for _, found in pairs}) == len(planted)
    for frame, found in pairs:
        for part in frame.key_hint.split("/"):
            assert part.lstrip("0") in found.key
        assert_same(seen_in(frame, found), found)


def nearest(frame: PlantedFrame, read: list[MultiViewFrame]) -> MultiViewFrame:
    """Return the frame whose joints lie nearest in the cameras that both have."""

    def distance(other: MultiViewFrame) -> float:
        places = [
            (frame.view_names.index(name), i)
            for i, name in enumerate(other.view_names)
            if name in frame.view_names
        ]
        ours, theirs = np.array(places, int).reshape(-1, 2).T
        if not len(ours):
            return math.inf
        return float(np.abs(frame.joints_cam[ours] - other.joints_cam[theirs]).max())

    return min(read, key=distance)


def seen_in(frame: PlantedFrame, found: MultiViewFrame) -> PlantedFrame:
    """Return the planted frame with the views that were read, in their order."""
    assert len(found.view_names) == min(8, len(frame.view_names))
    if len(found.view_names) == len(frame.view_names) < 9:
        assert found.view_names[0] == frame.view_names[0]
    return take_views(frame, [frame.view_names.index(name) for name in found.view_names])


def assert_same(frame: PlantedFrame, found: MultiViewFrame) -> None:
    assert np.array_equal(found.size_wh, frame.size_wh)
    np.testing.assert_allclose(found.joints_cam, frame.joints_cam, rtol=0, atol=METRES)
    np.testing.assert_allclose(found.vertices_cam, frame.vertices_cam, rtol=0, atol=METRES)
    np.testing.assert_allclose(found.keypoints_px, frame.keypoints_px, rtol=0, atol=PIXELS)
    np.testing.assert_allclose(found.K, frame.K, rtol=0, atol=PIXELS)
    ours, theirs = (of.T_cam_from_world @ invert_rigid(of.T_cam_from_world[0]) for of in (frame, found))
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=METRES)
    if found.pose_cam is not None:
        np.testing.assert_allclose(turns(found.pose_cam), turns(frame.pose_cam), rtol=0, atol=1e-4)
        np.testing.assert_allclose(found.shape, np.tile(frame.shape, (len(found.images), 1)), atol=1e-5)
    for encoded, image in zip(found.images, frame.images, strict=True):
        pixels = cv2.imdecode(np.frombuffer(encoded.data, np.uint8), cv2.IMREAD_COLOR)
        assert pixels.shape == image.shape
        assert np.abs(pixels[::4, ::4, ::-1] - image[::4, ::4].astype(float)).mean() < 6


def turns(pose: np.ndarray) -> np.ndarray:
    """Return rotations, in which a turn has one form."""
    flat = np.asarray(pose, np.float64).reshape(-1, 3)
    return np.stack([cv2.Rodrigues(vector)[0] for vector in flat])


@pytest.mark.parametrize("name", ["oakink", "dexycb", "arctic", "ho3d-v3", "freihand"])
def test_poses_are_read_where_the_set_has_them(miniature, mano_file, name):
    for source in raw_sources(name, miniature(name).root, mano_file):
        # HO-3D's official evaluation labels are joints and vertices alone.
        assert (source[0].pose_cam is None) == source.name.endswith("evaluation-mv")


@pytest.mark.parametrize("name", ["arctic", "interhand"])
def test_a_flipped_sample_says_about_which_column_its_pictures_are_turned(miniature, mano_file, name):
    written = miniature(f"tars-{name}")
    read = [ReleasedTars(path, mano=mano_file)[0] for path in archives(written.root)]
    flipped = nearest(written.planted[1], read)
    np.testing.assert_allclose(flipped.mirror_px, written.planted[1].K[:, 0, 2], atol=PIXELS)
