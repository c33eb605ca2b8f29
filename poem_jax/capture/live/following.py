"""Which detections of a moment are which hand, by what was seen before; what comes later changes nothing.

Views are matched moment by moment as in a take (`capture.hand_matching`). A hand stays itself by where its
motion takes it, and by the detector's sides; which of the followed hands is the right and which the left one
the sides of all moments say, so that a few wrong ones exchange nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from poem_jax.capture.hand_matching import PlacedHand, match_views
from poem_jax.capture.hand_tracks import (
    MAX_LINK,
    MOTION_SCALE_M,
    SURE_LINK,
    WEIGHT_OF_VOTES,
    cost_of_sides,
    mean_distance,
)
from poem_jax.capture.sightings import NONE, SightingsOfFrames
from poem_jax.detection import DetectedHand
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.world_origin import distant_origin, move_origin
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.typing import Array, Float

SIDES = ("right", "left")
"""The hands of a live picture: one person's."""

_FORGET_S = 1.0
"""A hand that was not seen for longer is a new one."""
_STEP_S = 1 / 30
"""The motion that is nothing unusual (`MOTION_SCALE_M`) is that of so long; it grows as the root of time."""
_DAMPING = 0.8
_LEAST_VOTE, _LEAST_SEEN = 1.0, 5
"""A hand has no side before its votes, log odds, or the moments that show it, are so many."""
_MOST_OF_MOMENT, _MOST_VOTE, _MOST_LINK_VOTE = 1.0, 6.0, 3.0
"""What one moment, and all together, can say of a side; and what it can say against a hand's going on."""
_HELD = 3.0
"""Nats for which a hand keeps its side."""


class FollowedHands(NamedTuple):
    """The hands of a moment, in the order of `SIDES`."""

    keypoints_px: Float[Array, "hand view 21 2"]
    """Raw pixels as given; NaN = unseen."""
    score: Float[Array, "hand view"]
    """Of the detections, 0.5 to 1; NaN = unseen."""
    placed: int
    """Hands that two views or more agree on, those of no side among them."""


@dataclass
class _Track:
    """A hand that is followed."""

    joints_world: Float[Array, "21 3"]
    time_s: float
    """When it was seen last."""
    vote: float
    """Log odds that it is a right hand."""
    velocity: Float[Array, "3"]
    seen: int = 1
    side: int | None = None
    found: Array | None = None
    """Its detections of this moment; None = unseen."""

    def cost(self, hand: PlacedHand, time_s: float) -> float:
        """Return what it costs that a hand is this one, nats."""
        step_s = time_s - self.time_s
        expected = self.joints_world + self.velocity * min(step_s, 4 * _STEP_S)
        scale = MOTION_SCALE_M * np.sqrt(max(step_s / _STEP_S, 1.0))
        votes = np.clip((self.vote, hand.vote), -_MOST_LINK_VOTE, _MOST_LINK_VOTE)
        return mean_distance(expected, hand.joints_world) / scale + cost_of_sides(*votes)

    def go_on(self, hand: PlacedHand, time_s: float) -> None:
        """Take a hand for this one."""
        now = np.where(np.isfinite(hand.joints_world), hand.joints_world, self.joints_world)
        moved = (now - self.joints_world)[np.isfinite(now - self.joints_world).all(-1)]
        speed = np.median(moved, axis=0) / (time_s - self.time_s) if len(moved) else np.zeros(3)
        self.velocity = _DAMPING * speed
        self.joints_world, self.time_s, self.found = now, time_s, hand.found
        self.vote = float(np.clip(self.vote + _vote_of(hand), -_MOST_VOTE, _MOST_VOTE))
        self.seen += 1

    def merit(self, side: int) -> float:
        """Return how well the side suits it, nats; minus infinity as long as it may have none."""
        if abs(self.vote) < _LEAST_VOTE and self.seen < _LEAST_SEEN:
            return -np.inf
        return (self.vote if side == 0 else -self.vote) + _HELD * (self.side == side)


class HandFollower:
    """Follows the hands of one person through the moments of running cameras."""

    def __init__(self, rig: Rig) -> None:
        near = move_origin(rig.T_cam_from_world, distant_origin(rig.T_cam_from_world))
        self._rig = rig._replace(T_cam_from_world=near)
        self._tracks: list[_Track] = []

    def follow(self, time_s: float, found: Sequence[Sequence[DetectedHand]]) -> FollowedHands:
        """Take in a moment, later than the last.

        Args:
            time_s: The moment, seconds.
            found: By view, the hands in its image; pixels of the raw image.
        """
        sightings = SightingsOfFrames([found], self._rig)[0]
        hands = match_views(sightings, len(SIDES))
        self._link(hands, time_s)
        self._name_sides()
        keypoints = np.full((len(SIDES), len(found), NUM_JOINTS, 2), np.nan)
        score = np.full(keypoints.shape[:2], np.nan)
        for track in self._tracks:
            if track.side is not None and track.found is not None:
                for view in np.flatnonzero(track.found != NONE).tolist():
                    hand = found[view][sightings.number[track.found[view]]]
                    keypoints[track.side, view] = hand.keypoints_px
                    score[track.side, view] = hand.score
        return FollowedHands(keypoints, score, len(hands))

    def _link(self, hands: Sequence[PlacedHand], time_s: float) -> None:
        """Let hands go on as those before, each once, or begin."""
        self._tracks = [track for track in self._tracks if time_s - track.time_s <= _FORGET_S]
        n, m = len(self._tracks), len(hands)
        # One more column for every track (it is not seen) and one more row for every hand (it begins).
        table = np.zeros((n + m, n + m))
        table[:n, m:] = table[n:, :m] = MAX_LINK / 2
        for row, track in enumerate(self._tracks):
            table[row, :m] = [min(track.cost(hand, time_s), 2 * MAX_LINK) for hand in hands]
            track.found = None
        linked = zip(*linear_sum_assignment(table), strict=True)
        before = {int(column): int(row) for row, column in linked if row < n and column < m}
        for number, hand in enumerate(hands):
            if number in before:
                self._tracks[before[number]].go_on(hand, time_s)
            else:
                self._tracks.append(
                    _Track(hand.joints_world, time_s, _vote_of(hand), np.zeros(3), found=hand.found)
                )

    def _name_sides(self) -> None:
        """Give each side to the hand that it suits best; one that it does not suit at all has none."""
        merit = np.array([[track.merit(side) for side in range(len(SIDES))] for track in self._tracks])
        for track in self._tracks:
            track.side = None
        if not len(merit):
            return
        usable = np.where(merit > -SURE_LINK, merit, -SURE_LINK)
        for row, side in zip(*linear_sum_assignment(-usable), strict=True):
            if merit[row, side] > -SURE_LINK:
                self._tracks[row].side = int(side)


def _vote_of(hand: PlacedHand) -> float:
    """Return what a moment says of the side: the views of one, and successive ones, err together."""
    return float(np.clip(WEIGHT_OF_VOTES * hand.vote, -_MOST_OF_MOMENT, _MOST_OF_MOMENT))
