"""Positions of the stream: shares, epochs, and the one law that makes a run resumable."""

from collections import Counter

import numpy as np
import pytest

from poem_jax.mixture.schedule import BLOCK, Schedule, frame_at

PAPER = (0.18, 0.18, 0.18, 0.18, 0.18, 0.10)


@pytest.mark.parametrize("shares", [PAPER, (0.5, 0.5), (1 / 3, 1 / 3, 1 / 3), (0.001, 0.999), (1.0,)])
def test_shares_are_exact_to_one_sample_over_whole_blocks(shares):
    schedule = Schedule(shares, seed=3)
    seen = Counter()
    for position in range(5 * BLOCK):
        seen[schedule.at(position).part] += 1
        if (position + 1) % BLOCK == 0:
            for part, share in enumerate(shares):
                assert abs(seen[part] - share * (position + 1)) <= 1


def test_chance_orders_a_block():
    """Within fifty positions shares are those of a draw, not of a fixed pattern."""
    parts = np.array([Schedule(PAPER, seed=0).at(i).part for i in range(2 * BLOCK)])
    assert not np.array_equal(parts[:BLOCK], parts[BLOCK:])
    counts = (parts.reshape(-1, 50) == 5).sum(1)
    assert 1.0 < counts.std() < 3.0  # sqrt(50 * 0.1 * 0.9) = 2.1


def test_a_part_counts_its_samples_without_a_gap():
    """`number` is what counting from the start gives, asked for in any order."""
    schedule, counted = Schedule((0.37, 0.25, 0.38), seed=1), Counter()
    turns = {}
    for position in range(2500):
        turn = schedule.at(position)
        assert turn.number == counted[turn.part]
        counted[turn.part] += 1
        turns[position] = turn
    again = Schedule((0.37, 0.25, 0.38), seed=1)
    for position in (2499, 0, 1001, 1000, 999):
        assert again.at(position) == turns[position]
    assert Schedule((0.37, 0.25, 0.38), seed=2).at(0) is not None
    assert any(Schedule((0.37, 0.25, 0.38), seed=2).at(i) != turns[i] for i in range(100))


def test_every_frame_comes_once_an_epoch_in_an_order_of_that_epoch():
    epochs = [[frame_at(7, 0, 11 * epoch + i, 11) for i in range(11)] for epoch in range(4)]
    assert all(sorted(epoch) == list(range(11)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4
    assert epochs[0] != [frame_at(7, 1, i, 11) for i in range(11)]


def test_attempts_go_on_in_the_order_of_the_epoch():
    order = [frame_at(7, 0, i, 11) for i in range(11)]
    for number in range(11):
        tries = [frame_at(7, 0, number, 11, attempt) for attempt in range(11)]
        assert tries == [*order[number:], *order[:number]]


def test_positions_begin_at_zero():
    with pytest.raises(ValueError, match=r"`position` must not be negative; got -1"):
        Schedule((1.0,), seed=0).at(-1)
