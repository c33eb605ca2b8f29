"""The planted truth agrees with itself, and a stand-in for MANO's file is read as the hand that it holds."""

from pathlib import Path

import numpy as np
import pytest

from poem_jax.geometry.cameras import project, project_cam
from poem_jax.geometry.transforms import invert_rigid, transform_points
from poem_jax.hand.mano_file import load, load_pose_components
from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand, write_mano
from poem_jax.miniatures.scene import (
    PlantedFrame,
    anchored,
    draw_rig,
    mano_translation,
    mirrored,
    plant,
    take_views,
    with_mesh_tips,
)

NAMES = ("a", "b", "c")
SIZES = [(320, 240), (240, 320), (320, 240)]


@pytest.fixture(scope="session", params=["right", "left"])
def frame(request: pytest.FixtureRequest) -> tuple[PlantedFrame, str]:
    rig = draw_rig((3, 1), NAMES, SIZES)
    return plant((3, 2), rig, stand_in_hand(request.param), key_hint="x/1"), request.param


def test_one_hand_is_seen_by_all_cameras(frame: tuple[PlantedFrame, str]) -> None:
    planted, _ = frame
    for points_cam in (planted.joints_cam, planted.vertices_cam):
        world = transform_points(invert_rigid(planted.T_cam_from_world), points_cam)
        np.testing.assert_allclose(world, np.broadcast_to(world[0], world.shape), rtol=0, atol=1e-9)
    pixels, depth = project(
        planted.K,
        planted.T_cam_from_world,
        transform_points(invert_rigid(planted.T_cam_from_world), planted.joints_cam),
    )
    np.testing.assert_allclose(pixels, planted.keypoints_px, rtol=0, atol=1e-6)
    assert (depth > 0.2).all()


def test_pose_shape_and_translation_give_the_vertices(frame: tuple[PlantedFrame, str]) -> None:
    planted, side = frame
    hand = stand_in_hand(side)
    shape = np.repeat(planted.shape[None], len(NAMES), axis=0)
    mesh = hand_mesh(hand, planted.pose_cam, shape, translation=mano_translation(hand, planted))
    np.testing.assert_allclose(mesh.vertices, planted.vertices_cam, rtol=0, atol=1e-6)
    np.testing.assert_allclose(mesh.joints, planted.joints_cam, rtol=0, atol=1e-6)


def test_a_picture_shows_the_hand_where_the_key_points_are(frame: tuple[PlantedFrame, str]) -> None:
    planted, side = frame
    elsewhere = plant((3, 4), draw_rig((3, 1), NAMES, SIZES), stand_in_hand(side), key_hint="")
    for view, image in enumerate(planted.images):
        width, height = planted.size_wh[view]
        assert image.shape == (height, width, 3)
        assert image.dtype == np.uint8
        knuckle = planted.joints_cam[view, [1, 5, 9, 13, 17]].mean(0)
        u, v = project_cam(planted.K[view], knuckle[None])[0].astype(int)
        patch = image[v - 2 : v + 3, u - 2 : u + 3].astype(int)
        assert patch.reshape(-1, 3).std(0).max() < 30  # skin, not the background's noise
        assert (image != elsewhere.images[view]).any(-1).mean() > 0.01


def test_a_scene_is_a_function_of_its_seed() -> None:
    rig = draw_rig(5, NAMES[:1], (160, 120))
    hand = stand_in_hand()
    once, again = (plant(6, rig, hand, key_hint="") for _ in range(2))
    other = plant(7, rig, hand, key_hint="")
    np.testing.assert_array_equal(once.images[0], again.images[0])
    np.testing.assert_array_equal(once.joints_cam, again.joints_cam)
    assert np.abs(once.joints_cam - other.joints_cam).max() > 1e-3


def test_a_mirrored_frame_projects_to_mirrored_pixels(frame: tuple[PlantedFrame, str]) -> None:
    planted, _ = frame
    other = mirrored(planted)
    np.testing.assert_allclose(project_cam(other.K, other.joints_cam), other.keypoints_px, atol=1e-6)
    np.testing.assert_allclose(
        other.keypoints_px[..., 0] + planted.keypoints_px[..., 0],
        np.broadcast_to(2 * planted.K[:, None, 0, 2], other.keypoints_px.shape[:2]),
    )
    world = transform_points(invert_rigid(other.T_cam_from_world), other.joints_cam)
    np.testing.assert_allclose(world, np.broadcast_to(world[0], world.shape), rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(other.T_cam_from_world), 1.0)


def test_views_and_world_can_be_chosen(frame: tuple[PlantedFrame, str]) -> None:
    planted, _ = frame
    chosen = anchored(take_views(planted, [2, 0]), 0)
    assert chosen.view_names == ("c", "a")
    np.testing.assert_array_equal(chosen.T_cam_from_world[0], np.eye(4))
    moved = transform_points(chosen.T_cam_from_world[1], chosen.joints_cam[0])
    np.testing.assert_allclose(moved, planted.joints_cam[0], rtol=0, atol=1e-9)


def test_mesh_tips_move_tips_alone(frame: tuple[PlantedFrame, str]) -> None:
    planted, _ = frame
    moved = np.linalg.norm(with_mesh_tips(planted).joints_cam - planted.joints_cam, axis=-1)
    tips = np.zeros(21, bool)
    tips[[4, 8, 12, 16, 20]] = True
    assert (moved[:, ~tips] == 0).all()
    assert (moved[:, tips] > 1e-4).all()
    assert (moved[:, tips] < 0.02).all()


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_stand_in_is_read_as_a_mano_file(tmp_path: Path, side: str) -> None:
    path = write_mano(tmp_path / "models" / f"MANO_{side.upper()}.pkl", side)
    for got, expected in zip(load(path), stand_in_hand(side), strict=True):
        np.testing.assert_array_equal(got, expected)
    components = load_pose_components(path)
    for got, expected in zip(components, stand_in_components(side), strict=True):
        np.testing.assert_array_equal(got, expected)
    assert np.linalg.norm(components.mean) > 1
    np.testing.assert_allclose(components.components @ components.components.T, np.eye(45), atol=1e-5)
