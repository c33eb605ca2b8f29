"""Drawing basis points: those in the ball, each once, in an order that the key gives and masked views do not
change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.models.ball_query import draw_ball, filled, points_at
from poem_jax.models.frustum_config import FrustumConfig
from poem_jax.models.poem_v1_config import BallConfig

BALL = BallConfig(40, 0.5, FrustumConfig(4))
CENTRE = jnp.array([[0.1, 0.0, 0.0], [0.0, -0.2, 0.0]])


@pytest.fixture
def grid():
    """Points in a cube about the origin, more of them in the ball than are drawn."""
    return np.random.default_rng(0).uniform(-0.7, 0.7, (2, 3, 5, 4, 4, 3)).astype(np.float32)


def _draw(grid, mask=None, key=0, config=BALL):
    mask = np.ones(grid.shape[:2], bool) if mask is None else np.array(mask, bool)
    return draw_ball(config, jnp.asarray(grid), CENTRE[: len(grid)], jnp.asarray(mask), jax.random.key(key))


def _inside(grid):
    return np.linalg.norm(grid - np.asarray(CENTRE)[:, None, None, None, None], axis=-1) < BALL.radius


def test_points_lie_in_the_ball_and_come_once(grid):
    ball = _draw(grid)
    inside = _inside(grid).reshape(2, -1)
    np.testing.assert_array_equal(ball.count, inside.sum(-1))
    assert (np.asarray(ball.count) > BALL.num_points).all()
    for b in range(2):
        assert len(set(np.asarray(ball.index[b]))) == BALL.num_points
        assert inside[b, ball.index[b]].all()
    np.testing.assert_array_equal(points_at(grid, ball.index)[1], grid[1].reshape(-1, 3)[ball.index[1]])


def test_every_point_of_the_ball_is_as_likely_and_other_keys_draw_others(grid):
    inside = np.flatnonzero(_inside(grid)[0])
    drawn = [np.asarray(_draw(grid[:1], key=key).index[0]) for key in range(60)]
    counts = np.bincount(np.concatenate(drawn), minlength=inside.max() + 1)[inside]
    share = BALL.num_points / len(inside)
    # Binomial counts: 60 draws, five standard deviations.
    assert np.abs(counts - 60 * share).max() < 5 * np.sqrt(60 * share * (1 - share))
    assert set(drawn[0]) != set(drawn[1])


def test_samples_share_the_order(grid):
    """As in the release, whose permutation is that of a batch."""
    same = np.concatenate([grid[:1], grid[:1]])
    first, second = (np.asarray(_draw(part).index) for part in (grid[:1], same))
    np.testing.assert_array_equal(first[0], second[0])


def test_masked_views_are_not_drawn_and_change_nothing(grid):
    size = grid[0, 0].size // 3
    expected = np.asarray(_draw(grid[:, [0, 2]]).index)
    found = np.asarray(_draw(grid, [[1, 0, 1]] * 2).index)
    np.testing.assert_array_equal(found, np.where(expected >= size, expected + size, expected))


def test_what_a_ball_lacks_is_told_and_filled_by_its_first(grid):
    few = BallConfig(40, 0.3, FrustumConfig(4))
    ball = _draw(grid, config=few)
    count = int(ball.count[0])
    assert 0 < count < 40
    index = np.asarray(ball.index[0])
    assert (index[:count] >= 0).all()
    assert (index[count:] == -1).all()
    np.testing.assert_array_equal(filled(ball.index)[0], [*index[:count]] + [index[0]] * (40 - count))
    np.testing.assert_array_equal(filled(jnp.array([[-1, 7, -1, 3, 0]])), [[7, 7, 7, 3, 0]])
    np.testing.assert_array_equal(points_at(grid, ball.index)[0, count:], 0)


def test_an_empty_ball_counts_nothing(grid):
    ball = _draw(grid + 10)
    np.testing.assert_array_equal(ball.count, 0)
    assert (np.asarray(ball.index) == -1).all()
    np.testing.assert_array_equal(filled(ball.index), 0)
