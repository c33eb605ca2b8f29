"""Rigs that stand still: the cameras are those written down, and only the hand moves."""

from dataclasses import replace

import numpy as np
import pytest

from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.table_rigs import RING, TABLE_RIGS, captures_of
from poem_jax.synthetic.viewpoints import standing_cameras

CAMERAS = [
    (5327.0501210828, 500.0631683877),
    (2727.8255668300, 144.7672795341),
    (2744.9688582522, 164.2766457711),
]
"""Sums of focal lengths and of weighted extrinsics."""
SMALL = replace(benchmark, image_hw=(32, 32), supersample=1, num_backgrounds=2)


@pytest.mark.parametrize("rig", TABLE_RIGS, ids=lambda rig: rig.name)
def test_all_cameras_stand_where_they_should_and_see_the_hand(rig):
    captures = SyntheticDataset(captures_of(rig, SMALL), rig.test_seed)
    roots = []
    for index in range(40):
        scene = captures.draw_scene(index)
        at = scene.viewpoints
        places = [camera.place_m for camera in rig.cameras]
        np.testing.assert_allclose(invert_rigid(at.T_cam_from_world)[:, :3, 3], places, atol=1e-9)
        joints = np.tile(scene.body.joints_world.astype(float), (len(places), 1, 1))
        uv, depth = project(at.K_frame, at.T_cam_from_world, joints)
        assert (depth > 0.3).all()
        assert ((uv > 0) & (uv < at.frame_wh[:, None])).all(-1).mean() > 0.95
        roots.append(scene.body.joints_world[9])
    assert np.std(roots, axis=0).min() > 0.05
    assert np.abs(roots).max() <= 0.12


def test_upright_cameras_see_down_below():
    captures = SyntheticDataset(captures_of(RING, SMALL), 1)
    T = captures.draw_scene(0).viewpoints.T_cam_from_world
    upright = [camera.roll_deg == 0 for camera in RING.cameras]
    down = T[upright][:, :3, :3] @ np.array([0.0, 0, -1])
    assert (down[:, 1] > 0.5).all()
    np.testing.assert_allclose(down[:, 0], 0, atol=1e-9)


def test_rolled_cameras_turn_the_picture():
    level, turned = (
        SyntheticDataset(
            captures_of(replace(RING, cameras=(replace(RING.cameras[0], roll_deg=roll),)), SMALL), 1
        )
        for roll in (0.0, 90.0)
    )
    a, b = (captures.draw_scene(0).viewpoints.T_cam_from_world[0] for captures in (level, turned))
    up_of = [T[:3, :3] @ np.array([0.0, 0, 1]) for T in (a, b)]
    assert up_of[0][1] < -0.5
    assert up_of[1][0] > 0.5, "what was up in the picture is now to the right"


@pytest.mark.parametrize("rig", TABLE_RIGS, ids=lambda rig: rig.name)
def test_the_first_two_cameras_look_from_far_apart(rig):
    a, b = (np.array(camera.place_m) / np.linalg.norm(camera.place_m) for camera in rig.cameras[:2])
    assert np.degrees(np.arccos(a @ b)) > 65


def test_a_rig_has_no_more_views_than_cameras():
    too_many = replace(captures_of(RING, SMALL), num_views=9)
    with pytest.raises(ValueError, match="at most the rig's 8 cameras; got 9"):
        SyntheticDataset(too_many, 1).draw_scene(0)


def test_the_test_frames_are_those_of_the_table():
    """Frozen before any training, the cameras too."""
    frozen = []
    sums = []
    for rig in TABLE_RIGS:
        sample = SyntheticDataset(captures_of(rig, SMALL), rig.test_seed).sample(499)
        sums.append(float(np.abs(sample.joints_world).sum()))
        K, _, T, _ = standing_cameras(rig.cameras)
        weights = np.arange(1, T.size + 1).reshape(T.shape)
        frozen.append((float(K[:, 0, 0].sum()), float((T * weights).sum())))
    np.testing.assert_allclose(frozen, CAMERAS, rtol=1e-9)
    np.testing.assert_allclose(sums, [6.338190, 6.417723, 4.153407], rtol=1e-5)
