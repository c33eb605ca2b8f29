"""Which detections of one frame are the same hand: groups of views whose rays meet in a plausible hand.

A group holds at most one detection a view; its joints are the points nearest to the rays (`sightings`).

The cost of a group is in nats: distances of the rays, size and proportions of the hand, and votes for
different sides. A detection that is in no group costs `DROP`, so that a group is worth `DROP` for each of its
views less its cost. Groups grow from every pair of detections that is worth something; the best are kept and
then improved by exchanging detections until nothing helps.
"""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np

from poem_jax.capture.keypoint_agreement import adult_hand_size
from poem_jax.capture.sightings import NONE, SAME_HAND_M, Sightings, ray_distances, trimmed_mean
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.typing import Array, Float, Int

DROP = 4.0
"""Cost of leaving a detection out, nats."""
RAY_SIGMA_M = 0.010
"""Distance of a ray from its joint that is nothing unusual: 5 % of a hand, as a detector's errors have tails
and rigs are not perfect (measured on real captures: 3 to 10 mm)."""
SURE_MATCH = 1.5
"""An exchange of two detections that costs less than this, nats, leaves it open which is right."""

_PAIR_WORTH = 3.7
"""What two views alone must be worth: the rays of two hands meet by chance for less (true pairs of real
captures: 3.9 and more, nine in ten above 6)."""
_SURE_PAIR = 5.0
"""What two views alone are worth where nothing else is said (of real pairs 99 of 100)."""
_PEOPLE = 3
"""In a frame others' hands are looked for too, so that a detection goes to the hand that it fits best."""
_INDEPENDENT_JOINTS = 3.0
"""The errors of a hand's 21 joints go together; they count as so many."""
_SCALE = (0.6, 1.45)
"""Size of a hand in sizes of the shipped one: palms (wrist to middle knuckle) of 0.055 to 0.132 m."""
_SCALE_SIGMA = 0.1
"""Of the logarithm of the size, beyond that range."""
_SHAPE_SIGMA_M = 0.012
_MAX_SHAPE_COST = 3.0
_MAX_SPREAD_M = 0.25
"""From the middle of a hand to any of its joints."""
_SEEDS_OF_DETECTION = 3
"""A pair seeds a group only if either of its detections is in fewer better pairs."""
_MAX_EXCHANGES = 30
_DAMPING = 1e-9


class PlacedHand(NamedTuple):
    """A hand that at least two views agree on."""

    joints_world: Float[Array, "21 3"]
    """Metres; NaN where fewer than two views give a ray."""
    found: Int[Array, " view"]
    """Which of the frame's detections; `NONE` where the view has none."""
    vote: float
    """Log odds that it is a right hand, of all views."""
    unsure_views: tuple[int, ...]
    """Views whose detection might as well be exchanged with another hand's."""


class _Trial(NamedTuple):
    """Groups with what they are worth."""

    found: Int[Array, "group view"]
    joints_world: Float[Array, "group 21 3"]
    value: Float[Array, " group"]


def match_views(sightings: Sightings, max_hands: int) -> list[PlacedHand]:
    """Return the hands of one frame that at least two views agree on, the best first.

    Args:
        sightings: Of the frame.
        max_hands: Of the take; more than `_PEOPLE` times as many are never returned.
    """
    if len(np.unique(sightings.view)) < 2:
        return []
    found = _grown(sightings, _seeds(sightings))
    chosen = _improved(sightings, _best(sightings, found, _PEOPLE * max_hands))
    trial = _without_doubles(sightings, _worthwhile(_trial(sightings, chosen)))
    unsure = _unsure_views(sightings, trial)
    order = np.argsort(-trial.value, kind="stable")
    return [
        PlacedHand(trial.joints_world[g], trial.found[g], _vote(sightings, trial.found[g]), tuple(unsure[g]))
        for g in order
    ]


def _vote(sightings: Sightings, found: Int[Array, " view"]) -> float:
    return float(sightings.votes[found[found != NONE]].sum())


def _seeds(sightings: Sightings) -> Int[Array, "group view"]:
    """Return the best pairs of detections of different views, for each detection some."""
    pairs = [
        (a, b)
        for a, b in combinations(range(len(sightings.view)), 2)
        if sightings.view[a] != sightings.view[b]
    ]
    found = np.full((len(pairs), sightings.num_views), NONE)
    for row, pair in zip(found, pairs, strict=True):
        row[sightings.view[list(pair)]] = pair
    found = _worthwhile(_trial(sightings, found)).found
    times = np.zeros(len(sightings.view), dtype=int)
    seeds = []
    for row in found:
        pair = row[row != NONE]
        if times[pair].min() < _SEEDS_OF_DETECTION:
            seeds.append(row)
            times[pair] += 1
    return np.array(seeds, dtype=int).reshape(-1, sightings.num_views)


def _grown(sightings: Sightings, seeds: Int[Array, "seed view"]) -> Int[Array, "group view"]:
    """Give each group the nearest detection of every view, if it is near enough to be the same hand."""
    found = seeds
    for _ in range(2):
        if not len(found):
            break
        joints, _ = _joints(sightings, found)
        distances = ray_distances(sightings, joints)
        cost = 0.5 * _INDEPENDENT_JOINTS * (distances / RAY_SIGMA_M) ** 2
        found = np.stack(
            [_nearest_of_view(cost, np.flatnonzero(sightings.view == v)) for v in range(sightings.num_views)],
            1,
        )
        found = np.unique(found[(found != NONE).sum(1) >= 2], axis=0)
    return found


def _nearest_of_view(cost: Float[Array, "group found"], here: Int[Array, " n"]) -> Int[Array, " group"]:
    if not here.size:
        return np.full(len(cost), NONE)
    nearest = here[cost[:, here].argmin(1)]
    return np.where(cost[np.arange(len(cost)), nearest] < DROP, nearest, NONE)


def _best(sightings: Sightings, found: Int[Array, "group view"], most: int) -> Int[Array, "chosen view"]:
    """Choose the most valuable group again and again, without the detections of those before."""
    chosen: list[Array] = []
    left = _worthwhile(_trial(sightings, found))
    while len(left.found) and len(chosen) < most:
        best, rest = left.found[0], left.found[1:]
        chosen.append(best)
        left = _Trial(*(array[1:] for array in left))
        if np.isin(rest, best[best != NONE]).any():
            rest = np.where(np.isin(rest, best), NONE, rest)
            rest = np.unique(rest[(rest != NONE).sum(1) >= 2], axis=0)
            left = _worthwhile(_trial(sightings, rest))
    return np.array(chosen, dtype=int).reshape(-1, sightings.num_views)


def _improved(sightings: Sightings, found: Int[Array, "group view"]) -> Int[Array, "group view"]:
    """Exchange detections between groups, leave them out or take them in, as long as the whole gains."""
    for _ in range(_MAX_EXCHANGES):
        steps, gains = _exchanges(sightings, found)
        if not len(gains) or gains.max() < 1e-6:
            break
        rows, changed = steps[int(gains.argmax())]
        found = found.copy()
        found[list(rows)] = changed
    return found


_Step = tuple[tuple[int, ...], Int[Array, "changed view"]]
"""Groups, and the detections that they get."""


def _exchanges(sightings: Sightings, found: Int[Array, "group view"]) -> tuple[list[_Step], Array]:
    """Return every change of one view, and what the whole gains by it."""
    steps = [*_swaps(found), *_replacements(sightings, found)]
    if not steps:
        return [], np.zeros(0)
    before = _gained(_trial(sightings, found))
    after = _gained(_trial(sightings, np.concatenate([changed for _, changed in steps])))
    lengths = np.array([len(rows) for rows, _ in steps])
    gained = np.add.reduceat(after, np.cumsum(lengths) - lengths)
    return steps, gained - np.array([before[list(rows)].sum() for rows, _ in steps])


def _swaps(found: Int[Array, "group view"]) -> Iterator[_Step]:
    for a, b in combinations(range(len(found)), 2):
        for view in np.flatnonzero(found[a] != found[b]):
            changed = found[[a, b]]
            changed[:, view] = changed[::-1, view]
            yield (a, b), changed


def _replacements(sightings: Sightings, found: Int[Array, "group view"]) -> Iterator[_Step]:
    """Yield groups with another, no or a first detection in a view, of those that no group has."""
    free = np.setdiff1d(np.arange(len(sightings.view)), found)
    for group, row in enumerate(found):
        for view in range(sightings.num_views):
            for number in (*free[sightings.view[free] == view], NONE):
                if number != row[view]:
                    changed = row[None].copy()
                    changed[0, view] = number
                    yield (group,), changed


def _unsure_views(sightings: Sightings, trial: _Trial) -> list[list[int]]:
    """Return, for every group, the views that could be exchanged with another group at hardly any loss.

    Of two views alone that fit badly, both.
    """
    weak = ((trial.found != NONE).sum(1) == 2) & (trial.value < _SURE_PAIR)
    unsure = [
        set(np.flatnonzero(row != NONE).tolist()) if is_weak else set()
        for row, is_weak in zip(trial.found, weak, strict=True)
    ]
    swaps = list(_swaps(trial.found))
    if swaps:
        changed = np.concatenate([changed for _, changed in swaps])
        after = _gained(_trial(sightings, changed)).reshape(-1, 2).sum(1)
        for ((a, b), changed), value in zip(swaps, after, strict=True):
            if trial.value[a] + trial.value[b] - value < SURE_MATCH:
                views = np.flatnonzero(changed[0] != trial.found[a])
                unsure[a].update(views.tolist())
                unsure[b].update(views.tolist())
    return [sorted(views) for views in unsure]


def _without_doubles(sightings: Sightings, trial: _Trial) -> _Trial:
    """Leave out groups all of whose detections are second ones of a better group's hand."""
    distances = ray_distances(sightings, trial.joints_world)
    kept: list[int] = []
    for group in np.argsort(-trial.value, kind="stable"):
        mine = trial.found[group][trial.found[group] != NONE]
        if not any((distances[better, mine] < SAME_HAND_M).all() for better in kept):
            kept.append(int(group))
    return _Trial(*(array[kept] for array in trial))


def _worthwhile(trial: _Trial) -> _Trial:
    """Return the groups that are worth more than their detections left out, the best first."""
    order = np.argsort(-trial.value, kind="stable")
    order = order[_gained(trial)[order] > 0]
    return _Trial(*(array[order] for array in trial))


def _gained(trial: _Trial) -> Float[Array, " group"]:
    """Return what groups are worth; zero where that is too little to be believed."""
    least = np.where((trial.found != NONE).sum(1) == 2, _PAIR_WORTH, 0)
    return np.where(trial.value > least, trial.value, 0)


def _trial(sightings: Sightings, found: Int[Array, "group view"]) -> _Trial:
    joints, square = _joints(sightings, found)
    views = (found != NONE).sum(1)
    rays = 0.5 * _INDEPENDENT_JOINTS * trimmed_mean(square) / RAY_SIGMA_M**2
    value = DROP * views - rays - _cost_of_form(joints) - _cost_of_sides(sightings, found)
    return _Trial(found, joints, np.where((views >= 2) & np.isfinite(value), value, -np.inf))


def _joints(
    sightings: Sightings, found: Int[Array, "group view"]
) -> tuple[Float[Array, "group 21 3"], Float[Array, "group 21"]]:
    """Return the points nearest to the rays, and the sum of their squared distances; NaN where undetermined.

    Least squares of distances in space, A X = b with A = sum_v (I - d d^T), b = sum_v (I - d d^T) c. NaN too
    for points behind a camera.
    """
    num = len(found)
    A, b = np.zeros((num, NUM_JOINTS, 3, 3)), np.zeros((num, NUM_JOINTS, 3))
    rest, count = np.zeros((2, num, NUM_JOINTS))
    for column in found.T:
        used = np.flatnonzero(column != NONE)
        found_here = column[used]
        pulls = sightings.pulls_world[found_here]
        A[used] += sightings.across_world[found_here]
        b[used] += pulls
        rest[used] += np.einsum("gja,ga->gj", pulls, sightings.centres_world[found_here])
        count[used] += np.isfinite(sightings.rays_world[found_here, :, 0])
    solvable = count >= 2
    damped = np.where(solvable[..., None, None], A, 0) + np.where(solvable, _DAMPING, 1)[
        ..., None, None
    ] * np.eye(3)
    points = np.linalg.solve(damped, b[..., None])[..., 0]
    # X^T A X - 2 X^T b + sum_v c^T (I - d d^T) c, where A X = b.
    square = np.maximum(rest - np.einsum("gja,gja->gj", b, points), 0)
    for column in found.T:
        used = np.flatnonzero(column != NONE)
        between = points[used] - sightings.centres_world[column[used]][:, None]
        along = np.einsum("gja,gja->gj", between, sightings.rays_world[column[used]])
        solvable[used] &= ~(along < 0)
    return np.where(solvable[..., None], points, np.nan), np.where(solvable, square, np.nan)


def _median(values: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the (lower) median of the finite values; 1 where there is none."""
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf), axis=-1)
    middle = np.maximum(np.isfinite(values).sum(-1, keepdims=True) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle, axis=-1)[..., 0]
    return np.where(np.isfinite(median), median, 1.0)


def _cost_of_form(joints_world: Float[Array, "group 21 3"]) -> Float[Array, " group"]:
    """Return what size and proportions cost; infinite for what spreads too far to be a hand."""
    adult = adult_hand_size()
    a, b = np.array(adult.bones).T
    lengths = np.linalg.norm(joints_world[:, a] - joints_world[:, b], axis=-1)
    scale = _median(lengths / adult.lengths_m)
    beyond = np.maximum(np.maximum(_SCALE[0] / np.maximum(scale, 1e-3), scale / _SCALE[1]), 1)
    misfit = trimmed_mean(np.abs(lengths - scale[:, None] * adult.lengths_m))
    shape = np.minimum(0.5 * (misfit / _SHAPE_SIGMA_M) ** 2, _MAX_SHAPE_COST)
    middle = np.where(np.isfinite(joints_world), joints_world, 0).sum(1, keepdims=True)
    middle = middle / np.maximum(np.isfinite(joints_world).sum(1, keepdims=True), 1)
    spread = np.sqrt(trimmed_mean(((joints_world - middle) ** 2).sum(-1)))
    return np.where(spread < _MAX_SPREAD_M, 0.5 * (np.log(beyond) / _SCALE_SIGMA) ** 2 + shape, np.inf)


def _cost_of_sides(sightings: Sightings, found: Int[Array, "group view"]) -> Float[Array, " group"]:
    """Return -log(prod P(right) + prod P(left)): small where the views agree on the side."""
    votes = np.where(found != NONE, sightings.votes[found], np.nan)
    right = np.nansum(np.log1p(np.exp(-votes)), axis=1)
    left = np.nansum(np.log1p(np.exp(votes)), axis=1)
    return -np.logaddexp(-right, -left)
