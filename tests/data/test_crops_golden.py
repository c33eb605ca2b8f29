"""The release's crops against arrays of POEM v1's own loader; skipped without ../shared."""

import cv2
import numpy as np
import pytest

from poem_jax.data.augmentation import RELEASE_V1, RELEASE_V2, draw, transform
from poem_jax.data.crops import Squares, release_crops, release_squares
from poem_jax.data.frames import EncodedImage, MultiViewFrame
from poem_jax.geometry.cameras import index_homography, transform_pixels
from poem_jax.geometry.transforms import invert_rigid, transform_points
from tests.conftest import SHARED

GOLDEN = SHARED / "reference" / "poem_v1" / "golden_transform_metrics.npz"
OUT_HW = (256, 256)
UNREAD = {"full/heatmap", "full/target_joints_uvd"}
"""What no model of ours reads: maps drawn for a loss that the release leaves out, and scaled depths."""
pytestmark = pytest.mark.skipif(not GOLDEN.is_file(), reason="needs ../shared")


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(GOLDEN) as arrays:
        return dict(arrays)


def case(golden: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {
        key.removeprefix(f"{name}/"): value for key, value in golden.items() if key.startswith(f"{name}/")
    }


def span(K_index: np.ndarray) -> np.ndarray:
    """K of the release, whose pixels count from a pixel's centre, in ours."""
    return K_index.astype(float) + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


@pytest.mark.parametrize("name", list("012345"))
def test_boxes_and_crops_are_the_releases(golden, name):
    g = case(golden, name)
    squares = release_squares(g["joints_2d"][None].astype(float) + 0.5, 1.0)
    np.testing.assert_array_equal(squares.center_px[0] - 0.5, g["box_center"])
    np.testing.assert_allclose(squares.side_px[0], g["box_scale"], rtol=1e-6)

    drawn = Squares(g["center"][None] + 0.5, g["scale"][None])
    crops = release_crops(span(g["K"])[None], drawn, g["rot"][None], OUT_HW)
    np.testing.assert_allclose(
        index_homography(crops.H_crop_from_image)[0], g["affine"], rtol=1e-6, atol=3e-5
    )
    np.testing.assert_allclose(crops.K[0], span(g["target_intr"]), rtol=1e-6, atol=3e-5)
    np.testing.assert_allclose(crops.K[0], span(g["affine_postrot"] @ g["K"]), rtol=1e-6, atol=3e-5)
    np.testing.assert_allclose(crops.T_turned_from_cam[0, :3, :3], g["R"], atol=1e-7)
    np.testing.assert_allclose(
        transform_points(crops.T_turned_from_cam[0], g["X"]), g["target_joints_3d"], atol=1e-7
    )
    # The release's extrinsics go from the camera to the master.
    T_cam_from_master = invert_rigid(g["T_cam_to_master"])
    np.testing.assert_allclose(
        invert_rigid(crops.T_turned_from_cam[0] @ T_cam_from_master), g["target_extr"], atol=1e-6
    )
    joints = transform_pixels(crops.H_crop_from_image[0], g["joints_2d"].astype(float) + 0.5) - 0.5
    np.testing.assert_allclose(joints, g["target_joints_2d"], rtol=1e-6, atol=3e-5)


def source_picture() -> np.ndarray:
    """The image behind `full/image`, found by fitting it: waves in red, ramps in green and blue."""
    y, x = np.mgrid[:480, :640].astype(float)
    waves = 127 + 90 * np.sin(x / 37) * np.cos(y / 29)
    return np.round(np.stack([waves, x / 639 * 255, y / 479 * 255], -1)).astype(np.uint8)


@pytest.mark.parametrize("recipe", [RELEASE_V1, RELEASE_V2])
def test_the_whole_transform_without_jitter_is_the_releases(golden, recipe):
    g = case(golden, "full")
    data = cv2.imencode(".png", source_picture()[..., ::-1])[1].tobytes()
    X = g["X"].astype(float)
    pixels = (X @ g["K"].T.astype(float))[:, :2] / (X[:, 2:] + 1e-6)  # as the release projects
    frame = MultiViewFrame(
        key="0",
        images=(EncodedImage(data, "picture"),),
        view_names=("0",),
        size_wh=np.array([[640, 480]]),
        K=span(g["K"])[None],
        T_cam_from_world=np.eye(4)[None],
        joints_cam=X[None],
        vertices_cam=np.repeat(X[None, :1], 778, 1),
        keypoints_px=pixels[None] + 0.5,
    )
    still = recipe.without_jitter()
    sample = transform(frame, np.array([0]), draw(still, 1, np.random.default_rng(0)), still, OUT_HW)
    np.testing.assert_allclose(sample.cameras.K[0], span(g["target_cam_intr"]), rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(sample.keypoints_px[0] - 0.5, g["target_joints_2d"], rtol=1e-6, atol=1e-4)
    difference = np.abs(sample.views[0].astype(int) - g["image"].transpose(1, 2, 0))
    assert difference.max() <= 1
    assert (difference > 0).mean() < 0.01
