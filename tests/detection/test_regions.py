"""Palms and regions: where things lie in an image, and how guesses are merged."""

import numpy as np
import pytest

from poem_jax.detection.palm_network import GUESS_SIZE, INPUT_SIZE, NUM_GUESSES
from poem_jax.detection.palms import Palm, find_palms, letterbox
from poem_jax.detection.regions import (
    Region,
    cut_out,
    into_image,
    overlap,
    region_of_hand,
    region_of_palm,
)

HW = (300, 400)


def turned(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def palm(points: np.ndarray) -> Palm:
    return Palm(np.concatenate([points.min(0), points.max(0)]), points, 0.9)


UPRIGHT = np.array([[150.0, 180], [130, 125], [150, 120], [170, 125], [185, 135], [120, 165], [110, 150]])


def picture_of_a_dot(at: np.ndarray) -> np.ndarray:
    """A bright square of 9 x 9 whose middle is at a place of the image, which spans [0, W] x [0, H]."""
    image = np.zeros((*HW, 3), np.uint8)
    column, row = (at - 0.5).astype(int)
    image[row - 4 : row + 5, column - 4 : column + 5] = 255
    return image


def middle_of_light(picture: np.ndarray) -> np.ndarray:
    weights = picture[..., 0].astype(float)
    rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]]
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


@pytest.mark.parametrize("turn", [0.0, 0.6, -2.5])
def test_what_is_cut_out_is_found_again(turn):
    region = Region(np.array([180.0, 140.0]), 260.0, turn)
    dot = np.array([205.5, 120.5])
    found = middle_of_light(cut_out(picture_of_a_dot(dot), region))
    # MediaPipe's pictures put pixel (0, 0) of image and crop onto each other: half a pixel of each is lost.
    np.testing.assert_allclose(into_image(found[None], region)[0], dot - 0.5, atol=0.1)


def test_a_letterbox_is_centred_and_its_border_is_black():
    white = letterbox(np.full((*HW, 3), 255, np.uint8))
    rows = np.flatnonzero(white[:, 96, 0] > 127)
    assert (rows[0], rows[-1]) == pytest.approx((24, 167), abs=1)
    assert not white[:20].any()


def guess(at: float, score: float, cell: int) -> tuple[np.ndarray, np.ndarray]:
    logits, values = np.full(NUM_GUESSES, -50.0), np.zeros((NUM_GUESSES, GUESS_SIZE))
    logits[cell] = np.log(score / (1 - score))
    values[cell] = np.tile([at, at], GUESS_SIZE // 2)
    values[cell, 2:4] = 40
    return logits, values


def test_a_guess_is_relative_to_its_cell():
    (one,) = find_palms(*guess(4.0, 0.8, cell=2 * (24 * 3 + 7)), (INPUT_SIZE, INPUT_SIZE))
    center = np.array([7.5, 3.5]) * 8 + 4
    np.testing.assert_allclose(one.box, [*(center - 20), *(center + 20)])
    np.testing.assert_allclose(one.points, np.tile(center, (7, 1)))
    (wide,) = find_palms(*guess(4.0, 0.8, cell=2 * (24 * 3 + 7)), (INPUT_SIZE, 2 * INPUT_SIZE))
    np.testing.assert_allclose(wide.points[0], 2 * center - [0, INPUT_SIZE / 2])


def test_guesses_that_overlap_are_averaged_by_score():
    (a, va), (b, vb) = (
        guess(d, s, cell=2 * (24 * 12 + 12) + i) for i, (d, s) in enumerate([(0, 0.9), (8, 0.6)])
    )
    (one,) = find_palms(np.maximum(a, b), va + vb, (INPUT_SIZE, INPUT_SIZE))
    assert one.score == pytest.approx(0.9)
    np.testing.assert_allclose(one.points[0], 12.5 * 8 + 8 * 0.6 / 1.5)


def test_guesses_apart_are_two_palms_the_surest_first():
    (a, va), (b, vb) = guess(0, 0.6, cell=0), guess(0, 0.9, cell=2 * (24 * 20 + 20))
    scores = [one.score for one in find_palms(np.maximum(a, b), va + vb, HW)]
    np.testing.assert_allclose(scores, [0.9, 0.6])


def test_unsure_guesses_are_none():
    assert find_palms(*guess(0, 0.49, cell=5), HW) == []


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.5, -3.0])
def test_a_palms_region_turns_with_it(angle):
    R = turned(angle)
    region = region_of_palm(palm(UPRIGHT))
    # The palm's box does not turn with it: only the place and turn of one with a square box do.
    points = UPRIGHT - UPRIGHT.mean(0)
    square = Palm(np.array([-40.0, -40, 40, 40]), points @ R.T, 0.9)
    moved = region_of_palm(square)
    assert np.angle(np.exp(1j * (moved.turn - region.turn - angle))) == pytest.approx(0, abs=1e-9)
    upright = region_of_palm(square._replace(points=points))
    np.testing.assert_allclose(moved.center, R @ upright.center, atol=1e-9)
    assert moved.side == pytest.approx(2.6 * 80)


@pytest.mark.parametrize("angle", [0.3, 2.0, -1.2])
def test_a_hands_region_turns_moves_and_grows_with_it(angle):
    hand = np.random.default_rng(1).random((21, 2)) * 100
    before = region_of_hand(hand)
    after = region_of_hand(3 * hand @ turned(angle).T + [50.0, -20.0])
    np.testing.assert_allclose(after.center, 3 * turned(angle) @ before.center + [50.0, -20.0], atol=1e-9)
    assert after.side == pytest.approx(3 * before.side)
    assert np.angle(np.exp(1j * (after.turn - before.turn - angle))) == pytest.approx(0, abs=1e-9)


def test_overlap_of_regions():
    a = Region(np.zeros(2), 2.0, 0.3)
    assert overlap(a, a) == pytest.approx(1)
    assert overlap(a, a._replace(center=np.array([1.0, 0]))) == pytest.approx(1 / 3)
    assert overlap(a, a._replace(center=np.array([5.0, 0]))) == 0
    assert overlap(a, a._replace(side=1.0)) == pytest.approx(1 / 4)
