"""Pixels, intrinsics, extrinsics and labels move together, for every recipe."""

import dataclasses
import math

import numpy as np
import pytest

from poem_jax.data.augmentation import NONE, PAPER, RELEASE_V1, RELEASE_V2, augment, draw, transform
from poem_jax.data.augmentation_recipes import CropFormulas, Recipe
from poem_jax.data.crops import exact_squares, release_squares
from poem_jax.data.frames import CorruptSampleError
from poem_jax.geometry.cameras import anchor_to_primary, project
from poem_jax.geometry.transforms import axis_angle_from_rotation, invert_rigid, rotation_about_z
from tests.data.planted_frames import SIZE_WH, blob_near, planted_frame

RECIPES = {"none": NONE, "paper": PAPER, "v1": RELEASE_V1, "v2": RELEASE_V2}
VIEWS = np.array([2, 0, 1])
OUT_HW = (128, 160)


def sample_of(recipe, frame, seed: int = 0, views=VIEWS, turn_all: bool = True):
    """Turned in every view that may turn, by angles that count."""
    if turn_all and recipe.turn:
        recipe = dataclasses.replace(recipe, turn_probability=1.0, turn=math.radians(20))
    draws = draw(recipe, len(views), np.random.default_rng(seed))
    return draws, transform(frame, views, draws, recipe, OUT_HW)


def gap(sample) -> np.ndarray:
    """Projections into the crops less the key points."""
    cameras = sample.cameras
    pixels, _ = project(
        cameras.K.astype(float),
        cameras.T_cam_from_world.astype(float),
        sample.joints_world[None].astype(float),
    )
    return pixels - sample.keypoints_px


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(
    ("name", "fx_over_fy", "skew"),
    [("none", 1.1, 4.0), ("paper", 1.1, 4.0), ("paper", 0.8, -9.0), ("v1", 1.0, 0.0), ("v2", 1.0, 0.0)],
)
def test_projections_follow_the_key_points(name, fx_over_fy, skew, mirrored):
    frame = planted_frame(fx_over_fy=fx_over_fy, skew=skew, mirrored=mirrored)
    for seed in range(3):
        draws, sample = sample_of(RECIPES[name], frame, seed)
        assert (name == "none") == (draws.angle == 0).all()
        np.testing.assert_allclose(gap(sample), 0, atol=1e-3)


@pytest.mark.parametrize("name", ["v1", "v2"])
def test_the_releases_error_with_unequal_focal_lengths_is_as_stated(name):
    frame = planted_frame(fx_over_fy=1.1)
    draws, sample = sample_of(RECIPES[name], frame)
    K, points = frame.K[VIEWS], frame.joints_cam[VIEWS]
    side = release_squares(frame.keypoints_px[VIEWS], 2.0).side_px * draws.scale
    focal_gap = np.abs(K[:, 0, 0] - K[:, 1, 1])
    radius = np.linalg.norm(points[..., :2] / points[..., 2:], axis=-1)
    stated = (OUT_HW[1] / side * np.abs(np.sin(draws.angle)) * focal_gap)[:, None] * radius
    assert stated.max() > 0.5
    np.testing.assert_allclose(np.linalg.norm(gap(sample), axis=-1), stated, atol=1e-3)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("name", RECIPES)
def test_pictures_follow_the_key_points(name, mirrored):
    recipe = dataclasses.replace(RECIPES[name], occlusion_probability=0.0, box_ratio=1.1)
    _, sample = sample_of(recipe, planted_frame(mirrored=mirrored), 1)
    found = 0
    for crop, points in zip(sample.views, sample.keypoints_px, strict=True):
        inside = (points > 10).all(-1) & (points < np.array(OUT_HW[::-1]) - 10).all(-1)
        for point in points[:20][inside[:20]]:
            np.testing.assert_allclose(blob_near(crop, point), point, atol=0.1)
            found += 1
    assert found > 25


@pytest.mark.parametrize("name", RECIPES)
def test_the_world_is_the_first_view_before_its_turn(name):
    frame = planted_frame()
    draws, sample = sample_of(RECIPES[name], frame)
    turned, _ = anchor_to_primary(frame.T_cam_from_world[VIEWS], np.ones(3, bool))
    turned = turned.copy()
    turned[:, :3] = rotation_about_z(draws.angle) @ turned[:, :3]
    np.testing.assert_allclose(sample.cameras.T_cam_from_world, turned, atol=1e-6)
    assert (draws.angle[0] != 0) == (name == "v1")
    np.testing.assert_allclose(sample.joints_world, frame.joints_cam[2], atol=1e-6)
    np.testing.assert_allclose(sample.vertices_world, frame.vertices_cam[2], atol=1e-6)
    np.testing.assert_allclose(sample.pose, frame.pose_cam[2], atol=1e-6)
    np.testing.assert_allclose(sample.shape, frame.shape[2], atol=1e-6)
    leaves = [leaf for leaf in (*sample[2:], *sample.cameras[:2]) if leaf is not None]
    assert {leaf.dtype for leaf in leaves} == {np.dtype(np.float32)}


def test_a_sample_is_a_function_of_the_generator():
    frame = planted_frame()
    one, two, other = (augment(frame, VIEWS, RELEASE_V1, OUT_HW, np.random.default_rng(s)) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.views, two.views)
    np.testing.assert_array_equal(one.cameras.K, two.cameras.K)
    assert (one.cameras.K != other.cameras.K).any()


def test_draws_have_the_recipes_spreads():
    draws = draw(RELEASE_V2, 20000, np.random.default_rng(0))
    np.testing.assert_allclose(draws.shift.std(0), 0.05, rtol=0.03)
    np.testing.assert_allclose([draws.scale.mean(), draws.scale.std()], [1, 0.06], atol=0.002)
    turned = draws.angle[1:] != 0
    assert draws.angle[0] == 0
    np.testing.assert_allclose(
        [turned.mean(), draws.angle[1:][turned].std()], [0.5, math.radians(5)], rtol=0.03
    )
    np.testing.assert_allclose(np.quantile(draws.gains, [0, 0.25, 1]), [0.7, 0.85, 1.3], atol=0.01)
    assert not draws.occluded.any()
    assert not draws.calibration_error.any()


def test_the_first_release_clips_and_hides():
    draws = draw(RELEASE_V1, 20000, np.random.default_rng(0))
    assert not draws.shift.any()
    np.testing.assert_allclose(np.abs(draws.scale - 1).max(), 0.18)
    np.testing.assert_allclose(np.abs(draws.angle).max(), math.radians(15))
    np.testing.assert_allclose(draws.occluded.mean(), 0.2, atol=0.01)
    np.testing.assert_allclose(draws.patch.min(0), [0, 0.5, 0, 0], atol=0.001)
    np.testing.assert_allclose(draws.patch.max(0), [0.2, 2, 1, 1], atol=0.001)
    assert draw(RELEASE_V2, 20000, np.random.default_rng(0)).scale.max() > 1.18


def test_the_releases_centre_is_truncated_where_pixels_count_from_the_first_centre():
    index = np.array([[[10.2, -30.7], [21.5, -4.0]]])
    release, exact = (squares(index + 0.5, 2.0) for squares in (release_squares, exact_squares))
    np.testing.assert_allclose(release.center_px - 0.5, [[15, -17]])
    np.testing.assert_allclose(exact.center_px - 0.5, [[15.85, -17.35]])
    np.testing.assert_allclose([release.side_px, exact.side_px], 2 * 26.7)


def test_a_prescribed_box_is_taken_before_the_key_points():
    frame = planted_frame(1)
    box = np.array([[60.0, 40.0, 140.0, 90.0]])
    _, sample = sample_of(NONE, frame._replace(box_px=box), views=np.array([0]))
    scale = OUT_HW[1] / 160
    moved = (frame.keypoints_px[0] - [100, 65]) * scale + [OUT_HW[1] / 2, OUT_HW[0] / 2]
    np.testing.assert_allclose(sample.keypoints_px[0], moved, atol=1e-3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_patches_of_noise_lie_on_the_hand(mirrored):
    frame, recipe = planted_frame(1, mirrored=mirrored), dataclasses.replace(NONE, box_ratio=1.0)
    draws = draw(recipe, 1, np.random.default_rng(0))._replace(occluded=np.array([True]))
    whole = transform(frame, np.array([0]), draws._replace(occluded=np.array([False])), recipe, (160, 160))
    for across in (0.0, 1.0):
        placed = draws._replace(patch=np.array([[0.16, 1.0, across, 0.5]]))
        hidden = transform(frame, np.array([0]), placed, recipe, (160, 160))
        changed = (hidden.views != whole.views)[0].any(-1)
        columns, rows = np.flatnonzero(changed.any(0)), np.flatnonzero(changed.any(1))
        # A square of 0.4 of the side, at the left or the right edge, half-way down.
        ends = [0, 64] if across == 0 else [96, 160]
        np.testing.assert_allclose([columns[0], columns[-1] + 1], ends, atol=6)
        np.testing.assert_allclose([rows[0], rows[-1] + 1], [48, 112], atol=6)
        assert changed[rows[0] : rows[-1], columns[0] : columns[-1]].mean() > 0.95


def test_patches_that_leave_the_image_are_left_out():
    frame, recipe = planted_frame(1), dataclasses.replace(NONE, box_ratio=4.0)
    draws = draw(recipe, 1, np.random.default_rng(0))
    outside = np.array([[0.16, 1.0, 0.5, 0.0]])  # the square reaches above the image
    pair = [
        transform(frame, np.array([0]), draws._replace(occluded=np.array([o]), patch=outside), recipe, OUT_HW)
        for o in (False, True)
    ]
    np.testing.assert_array_equal(pair[0].views, pair[1].views)


def test_calibration_errors_spare_the_first_view_and_the_pictures():
    frame, wrong = planted_frame(8), Recipe(rotation_noise=0.01, translation_noise=0.002)
    views, errors = np.arange(8), []
    for seed in range(20):
        _, right = sample_of(NONE, frame, seed, views)
        _, noisy = sample_of(wrong, frame, seed, views)
        np.testing.assert_array_equal(noisy.cameras.T_cam_from_world[0], np.eye(4))
        np.testing.assert_array_equal(noisy.cameras.K, right.cameras.K)
        np.testing.assert_array_equal(noisy.keypoints_px, right.keypoints_px)
        T = noisy.cameras.T_cam_from_world.astype(float) @ invert_rigid(
            right.cameras.T_cam_from_world.astype(float)
        )
        errors.append(np.concatenate([axis_angle_from_rotation(T[1:, :3, :3]), T[1:, :3, 3]], -1))
    np.testing.assert_allclose(np.std(errors, (0, 1)), [0.01] * 3 + [0.002] * 3, rtol=0.25)


def test_a_bad_image_names_its_sample():
    frame = planted_frame()
    images = (frame.images[0]._replace(data=frame.images[0].data[:-30]), *frame.images[1:])
    with pytest.raises(CorruptSampleError, match=r"shard\.tar: 0\.png, sample seq/7: .*damaged"):
        augment(frame._replace(images=images), VIEWS, PAPER, OUT_HW, np.random.default_rng(0))
    wrong_size = frame._replace(size_wh=frame.size_wh * 2)
    with pytest.raises(CorruptSampleError, match=f"is {SIZE_WH[0]} x {SIZE_WH[1]}; .* 640 x 480"):
        augment(wrong_size, VIEWS, PAPER, OUT_HW, np.random.default_rng(0))


def test_the_releases_recipes_do_not_shrink_while_decoding():
    with pytest.raises(ValueError, match="`shrinks_while_decoding`"):
        dataclasses.replace(RELEASE_V2, shrinks_while_decoding=True)
    kept = RELEASE_V1.without_jitter()
    assert kept == Recipe(formulas=CropFormulas.RELEASE)
