"""Cameras that do not show what the others show are named, with the cause; good captures are not."""

import numpy as np
import pytest

from poem_jax.calibration.epipolar import epipolar_distances_px, ideal_keypoints
from poem_jax.calibration.view_agreement import judge_views

NOISE_PX = 0.7
SIZE = np.array([1280, 720])


@pytest.mark.parametrize("num_views", [2, 3, 4, 8])
def test_views_that_fit_are_not_complained_about(num_views, ring, seen):
    rig = ring(num_views)
    assert judge_views(rig, seen(rig)) == []
    assert judge_views(rig, seen(rig, frames=1)) == []
    assert judge_views(rig, np.full((1, 1, num_views, 21, 2), np.nan)) == []
    assert judge_views(rig, seen(rig)[..., 9:10, :]) == [], "too few points to judge"


@pytest.mark.parametrize("num_views", [3, 4, 8])
def test_exchanged_cameras_are_named(num_views, ring, seen):
    rig = ring(num_views)
    keypoints = seen(rig)
    keypoints[:, :, [0, 2]] = keypoints[:, :, [2, 0]]
    (found,) = judge_views(rig, keypoints)
    assert found.name == "cameras exchanged"
    assert "'cam_0' is of 'cam_2'" in str(found)
    assert "'cam_2' is of 'cam_0'" in str(found)
    assert "'cam_1'" not in str(found)


def test_another_order_of_all_cameras_is_named(ring, seen):
    rig = ring(4)
    (found,) = judge_views(rig, seen(rig)[:, :, [1, 2, 3, 0]])
    assert found.name == "cameras exchanged"
    assert "'cam_3' is of 'cam_0'" in str(found), "the last place holds what the first camera saw"


FLIPS = {
    "mirrored left to right": lambda uv: np.stack([SIZE[0] - uv[..., 0], uv[..., 1]], -1),
    "turned by 180 degrees": lambda uv: SIZE - uv,
    "mirrored top to bottom": lambda uv: np.stack([uv[..., 0], SIZE[1] - uv[..., 1]], -1),
}


@pytest.mark.parametrize("flip", FLIPS)
@pytest.mark.parametrize("num_views", [3, 4, 8])
def test_a_flipped_image_is_named(flip, num_views, ring, seen):
    rig = ring(num_views)
    keypoints = seen(rig)
    keypoints[:, :, 1] = FLIPS[flip](keypoints[:, :, 1])
    (found,) = judge_views(rig, keypoints)
    assert found.name == "flipped image"
    assert f"'cam_1' seems to be {flip}" in str(found)


@pytest.mark.parametrize("num_views", [2, 3, 4])
def test_a_copied_image_is_named(num_views, ring, seen):
    rig = ring(num_views)
    keypoints = seen(rig)
    keypoints[:, :, 1] = keypoints[:, :, 0]
    (found,) = judge_views(rig, keypoints)
    assert found.name == "copied images"
    assert "'cam_0' and 'cam_1'" in str(found)


def test_a_black_image_is_named(ring, seen):
    """A network says something of any image: what it says of this one fits nothing."""
    rig = ring(4)
    keypoints = seen(rig)
    keypoints[:, :, 2] = np.random.default_rng(3).uniform(300, 500, (6, 1, 21, 2))
    (found,) = judge_views(rig, keypoints)
    assert found.name == "one view disagrees"
    assert "without 'cam_2' the others ('cam_0', 'cam_1', 'cam_3') agree" in str(found)
    assert "black" in str(found)


def test_views_of_which_none_fit_are_listed(ring, seen):
    rig = ring(3)
    keypoints = seen(rig) + np.random.default_rng(1).normal(0, 80, (6, 1, 3, 21, 2))
    (found,) = judge_views(rig, keypoints)
    assert found.name == "views disagree"
    assert "do not fit together" in str(found)
    assert judge_views(rig, keypoints, extent_share=1.0) == [], "a network may be off by so much"


def test_epipolar_distances_are_the_noise(ring, seen):
    rig = ring(4)
    distances = epipolar_distances_px(rig, ideal_keypoints(rig, seen(rig, frames=40)))
    assert np.isnan(np.diag(distances)).all()
    # The median of |N(0, sigma)|.
    np.testing.assert_allclose(distances[~np.eye(4, dtype=bool)], 0.6745 * NOISE_PX, rtol=0.15)


@pytest.mark.parametrize("num_views", [8, 24, 40])
def test_cameras_side_by_side_are_not_taken_for_copies_when_another_is_wrong(num_views, ring, seen):
    """A ring of many cameras, in which neighbours show much the same."""
    rig = ring(num_views)
    keypoints = seen(rig)
    keypoints[:, :, 3] += 60
    (found,) = judge_views(rig, keypoints)
    assert found.name == "camera moved", "60 px to the right are 3.8 degrees"
    assert "camera 'cam_3' alone" in str(found)
    assert len(str(found)) < 1500
