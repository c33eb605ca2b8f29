"""Detections that no second view confirms in their frame: the hand that expects them takes them.

A hand that loses all views but one is moved across the rays of that view and keeps its depth and form. A hand
that several views place takes detections that were too bad to help place it. Every free detection has a cost
(nats) for every hand, by motion, form and side; it is taken where no other hand is nearly as likely, and left
out with a warning otherwise. Hands are followed forwards through the take, then backwards for what is still
free.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from poem_jax.capture.hand_tracks import SURE_LINK, Track
from poem_jax.capture.sightings import NONE, Sightings, ray_distances, shifted_distances
from poem_jax.typing import Array, Bool, Float, Int

_MAX_AGE = 20
"""Frames without any detection after which a hand is not expected anywhere."""
_MAX_COST = 6.0
_FAR = _MAX_COST + SURE_LINK
"""Cost of what is of no hand."""
_MOVE_SCALE_M = 0.05
"""Unexpected motion from frame to frame."""
_FORM_SIGMA_M = 0.015
"""The hand turns and bends while one view follows it."""
_STRAGGLER_M = 0.035
"""The rays of a bad detection of a hand pass its joints within this."""
_MAX_SIDE_COST = 1.5
_DAMPING = 0.7


class _Taker(NamedTuple):
    """A hand in a frame that may take detections."""

    hand: int
    joints_world: Float[Array, "21 3"]
    vote: float
    spread: float
    """How many times as far as from frame to frame it may have moved; zero for a hand that has its place."""


class _State:
    """Where hands are expected while they are followed."""

    def __init__(self, num_hands: int) -> None:
        self.joints: dict[int, Float[Array, "21 3"]] = {}
        self.velocity = np.zeros((num_hands, 3))
        self.age = np.zeros(num_hands, dtype=int)
        """Frames since the hand was seen."""

    def place(self, hand: int, now: Float[Array, "21 3"]) -> None:
        """A hand was placed by several views."""
        before = self.joints.get(hand, now)
        if self.age[hand] == 0:
            self.velocity[hand] = _DAMPING * _median_move(before, now)
        self.joints[hand] = np.where(np.isfinite(now), now, before)
        self.age[hand] = 0

    def expect(self, hand: int) -> Float[Array, "21 3"] | None:
        """A hand was not placed: return where it may be, None after too long."""
        self.age[hand] += 1
        if hand not in self.joints or self.age[hand] > _MAX_AGE:
            return None
        return self.joints[hand] + self.velocity[hand] * (self.age[hand] == 1)

    def move(self, hand: int, expected: Float[Array, "21 3"], move: Float[Array, "3"]) -> None:
        """One view found a hand."""
        self.joints[hand] = expected + move
        seen_before = self.age[hand] == 1
        self.velocity[hand] = _DAMPING * (self.velocity[hand] + move) if seen_before else 0.0
        self.age[hand] = 0


def join_lone_detections(
    frames: Sequence[Sightings], tracks: Sequence[Track], found: Int[Array, "hand frame view"]
) -> tuple[Int[Array, "hand frame view"], list[tuple[int, int]]]:
    """Give hands the detections that no second view confirms.

    Args:
        frames: All detections.
        tracks: The hands.
        found: Which detection is which hand, by two views and more.

    Returns: `found` with what was joined, and the places (frame, view) of detections that could be of either
        of two hands and were left out.
    """
    doubtful: set[tuple[int, int]] = set()
    for order in (range(len(frames)), range(len(frames) - 1, -1, -1)):
        found, unsure = _pass(order, frames, tracks, found)
        doubtful |= unsure
    left = [
        (frame, view)
        for frame, view in sorted(doubtful)
        if not set(np.flatnonzero(frames[frame].view == view)) <= set(found[:, frame, view].tolist())
    ]
    return found, left


def _pass(
    order: Iterable[int],
    frames: Sequence[Sightings],
    tracks: Sequence[Track],
    found: Int[Array, "hand frame view"],
) -> tuple[Int[Array, "hand frame view"], set[tuple[int, int]]]:
    """Follow all hands in one direction of time."""
    found, state = found.copy(), _State(len(tracks))
    doubtful: set[tuple[int, int]] = set()
    for frame in order:
        takers = _takers(state, tracks, frame)
        while True:
            taken, unsure = _taken(frames[frame], takers, found[:, frame])
            doubtful |= {(frame, view) for view in unsure}
            for taker, number, move in taken:
                found[taker.hand, frame, frames[frame].view[number]] = number
                if taker.spread:
                    state.move(taker.hand, taker.joints_world, move)
            if not taken:
                break
            # A hand without a place has had its one detection; others may take one in another view.
            served = [taker.hand for taker, _, _ in taken if taker.spread]
            takers = [taker for taker in takers if taker.hand not in served]
    return found, doubtful


def _takers(state: _State, tracks: Sequence[Track], frame: int) -> list[_Taker]:
    takers = []
    for hand, track in enumerate(tracks):
        if frame in track.hands:
            state.place(hand, track.hands[frame].joints_world)
            takers.append(_Taker(hand, track.hands[frame].joints_world, track.vote, 0.0))
        elif (expected := state.expect(hand)) is not None:
            takers.append(_Taker(hand, expected, track.vote, float(np.sqrt(state.age[hand]))))
    return takers


def _median_move(before: Float[Array, "21 3"], now: Float[Array, "21 3"]) -> Float[Array, "3"]:
    moved = (now - before)[np.isfinite(now - before).all(-1)]
    return np.median(moved, axis=0) if len(moved) else np.zeros(3)


def _taken(
    sightings: Sightings, takers: Sequence[_Taker], found: Int[Array, "hand view"]
) -> tuple[list[tuple[_Taker, int, Float[Array, "3"]]], list[int]]:
    """Return (hand, detection, move) of those that are sure, and the views of detections that are not.

    A hand takes one detection at a time. What one view found on the way forwards is looked at again on the
    way back, where the hand may take nothing else.
    """
    placed = [taker.hand for taker in takers if not taker.spread]
    others = np.setdiff1d(np.arange(len(found)), [taker.hand for taker in takers])
    free = np.setdiff1d(np.arange(len(sightings.view)), found[[*placed, *others]])
    if not takers or not free.size:
        return [], []
    each = [_costs(sightings, taker, found[taker.hand]) for taker in takers]
    costs, allowed, moves = (np.stack(column)[:, free] for column in zip(*each, strict=True))
    rows, columns = linear_sum_assignment(np.where(allowed, costs, _FAR))
    taken, unsure = [], []
    for row, column in zip(rows, columns, strict=True):
        if not allowed[row, column] or costs[row, column] >= _MAX_COST:
            continue
        rival = np.delete(costs[:, column], row).min(initial=_FAR)
        if rival - costs[row, column] >= SURE_LINK:
            taken.append((takers[row], int(free[column]), moves[row, column]))
        else:
            unsure.append(int(sightings.view[free[column]]))
    return taken, unsure


def _costs(
    sightings: Sightings, taker: _Taker, found: Int[Array, " view"]
) -> tuple[Float[Array, " found"], Bool[Array, " found"], Float[Array, "found 3"]]:
    """Return what it costs that each detection is of a hand, whether it may take it, and the move to it."""
    sides = np.clip(-np.sign(taker.vote) * sightings.votes, 0, _MAX_SIDE_COST)
    mine = found[sightings.view]
    if taker.spread:
        moves, distance = shifted_distances(sightings, taker.joints_world)
        motion = np.linalg.norm(moves, axis=-1) / (_MOVE_SCALE_M * taker.spread)
        allowed = (mine == NONE) & (found == NONE).all() | (mine == np.arange(len(mine)))
    else:
        moves, distance = np.zeros((len(mine), 3)), ray_distances(sightings, taker.joints_world)
        motion, allowed = np.where(distance < _STRAGGLER_M, 0, _FAR), mine == NONE
    cost = motion + 0.5 * np.minimum(distance / _FORM_SIGMA_M, _FAR) ** 2 + sides
    return np.minimum(cost, _FAR), allowed, moves
