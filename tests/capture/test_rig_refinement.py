"""Cameras that were touched are put back by the hands, and a good rig is left as it is."""

import numpy as np
import pytest

from poem_jax.capture.rig_refinement import refine_rig
from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    invert_rigid,
    rigid,
    rotation_from_axis_angle,
)
from tests.calibration.test_linter import moving_take


def touched(rig, view, degrees, metres):
    rng = np.random.default_rng(view)
    turn, move = rng.normal(size=(2, 3))
    T = rig.T_cam_from_world.copy()
    change = rigid(
        rotation_from_axis_angle(np.radians(degrees) * turn / np.linalg.norm(turn)),
        metres * move / np.linalg.norm(move),
    )
    T[view] = change @ T[view]
    return rig._replace(T_cam_from_world=T)


def off(rig, other):
    """Degrees and metres between the cameras of two rigs."""
    change = rig.T_cam_from_world @ invert_rigid(other.T_cam_from_world)
    centres = [invert_rigid(r.T_cam_from_world)[:, :3, 3] for r in (rig, other)]
    degrees = np.degrees(np.linalg.norm(axis_angle_from_rotation(change[:, :3, :3]), axis=-1))
    return degrees, np.linalg.norm(centres[0] - centres[1], axis=-1)


@pytest.fixture(scope="module")
def take():
    return moving_take(frames=90, noise_px=0.5)


@pytest.mark.parametrize("view", [0, 2])
def test_a_touched_camera_comes_back(take, view):
    rig, uv = take
    refined = refine_rig(touched(rig, view, 1.0, 0.010), uv)
    degrees, metres = off(refined.rig, rig)
    assert degrees.max() < 0.1
    assert metres.max() < 0.001
    assert refined.helps
    assert refined.held_out_mean_px[1] < 0.3 * refined.held_out_mean_px[0]
    assert np.argmax(refined.moved_m) == view


def test_a_good_rig_stays(take):
    rig, uv = take
    refined = refine_rig(rig, uv)
    degrees, metres = off(refined.rig, rig)
    assert degrees.max() < 0.05
    assert metres.max() < 0.001
    assert not refined.helps


@pytest.mark.slow
def test_the_world_and_the_unit_do_not_matter(take):
    rig, uv = take
    wrong = touched(rig, 1, 1.0, 0.010)
    far = rigid(rotation_from_axis_angle(np.array([0.3, -1, 0.5])), np.array([500e3, 4500e3, 300.0]))
    moved = wrong._replace(T_cam_from_world=wrong.T_cam_from_world @ far)
    a, b = refine_rig(wrong, uv), refine_rig(moved, uv)
    assert np.abs(a.turned_rad - b.turned_rad).max() < 1e-5
    assert np.abs(a.moved_m - b.moved_m).max() < 1e-5


@pytest.mark.slow
def test_outliers_do_not_spoil_it(take):
    rig, uv = take
    rng = np.random.default_rng(1)
    wild = rng.random(uv.shape[:-1]) < 0.1
    uv = uv + 60 * wild[..., None] * rng.normal(size=uv.shape)
    degrees, metres = off(refine_rig(touched(rig, 2, 1.0, 0.010), uv).rig, rig)
    assert degrees.max() < 0.15
    assert metres.max() < 0.002


@pytest.mark.slow
def test_offsets_in_time_are_found_with_the_places():
    rig, uv = moving_take((0.0, 0.0, 0.6, 0.0), frames=90, noise_px=0.5)
    refined = refine_rig(touched(rig, 1, 1.0, 0.010), uv, offsets=True)
    assert np.abs(refined.frames_late - [0, 0, 0.6, 0]).max() < 0.1
    degrees, metres = off(refined.rig, rig)
    assert degrees.max() < 0.15
    assert metres.max() < 0.002


@pytest.fixture(scope="module")
def of_a_good_rig(take):
    return refine_rig(*take, offsets=True)


@pytest.mark.slow
def test_a_good_rig_has_no_offsets_in_time(of_a_good_rig):
    np.testing.assert_array_equal(of_a_good_rig.frames_late, 0)
    assert not of_a_good_rig.helps


@pytest.mark.slow
def test_the_frames_that_are_held_out_do_not_set_the_offsets(take, of_a_good_rig):
    rig, uv = take
    given = of_a_good_rig
    others = moving_take((0.0, 0.0, 1.5, 0.0), frames=90, noise_px=0.5)[1]
    held_out = np.arange(90) // 5 % 3 == 1
    spoiled = refine_rig(rig, np.where(held_out[:, None, None, None, None], others, uv), offsets=True)
    np.testing.assert_array_equal(spoiled.frames_late, given.frames_late)
    np.testing.assert_array_equal(spoiled.rig.T_cam_from_world, given.rig.T_cam_from_world)
    assert not np.allclose(spoiled.held_out_px, given.held_out_px)


def test_too_little_is_refused(take):
    rig, uv = take
    with pytest.raises(ValueError, match=r"at least 10 hands.*got 4.*longer take"):
        refine_rig(rig, uv[:6])
    blind = uv.copy()
    blind[:, :, 3] = np.nan
    with pytest.raises(ValueError, match=r"camera 'above'.*150 key points.*got 0"):
        refine_rig(rig, blind)
