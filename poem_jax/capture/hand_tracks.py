"""Which hands of all frames of a take are one: tracks by place, motion and the sides of detections.

First, hands of successive frames are linked where only one way is plausible: such a run is a piece. Where
hands cross, leave or jump, pieces end. Then pieces are joined to tracks, in the order of their beginnings: a
beam holds the likeliest ways to join all pieces so far, by place, motion and sides, so that what a hand turns
out to be later decides what it was at a crossing. Ways that are nearly as likely as the best become warnings.

Costs are in nats. Sides: with the log odds s of a track and t of a piece, joining costs
log cosh(s/2) + |t|/2 - log cosh((s + t)/2), about min(|s|, |t|) where they differ, little where they agree.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from poem_jax.capture.hand_matching import PlacedHand
from poem_jax.typing import Array, Float

SURE_LINK = 2.0
"""A way to follow hands must be likelier than any other by this, nats, to be taken for sure."""

MOTION_SCALE_M = 0.04
"""A hand is this far from where its motion takes it, in the mean over joints (exponential distribution)."""
MAX_LINK = 6.0
"""Cost of a link between neighbouring frames above which the hand is not the same, or has jumped."""
_JUMP_WEIGHT = 1.2
_MAX_JUMP = 4.0
"""Cost of any change of place between pieces, which grows as the logarithm: hands leave and come back
elsewhere."""
JUMP_M = 0.3
"""A hand that goes on further than this from where it was expected could be another person's."""
_BIRTH = 6.0
"""Cost of one more hand: more than a jump and what makes it sure."""
_DAMPING = 0.8
_MOST_FRAMES_AHEAD = 4
"""Velocity says nothing about where a hand is later than this."""
WEIGHT_OF_VOTES = 0.25
"""Votes of one hand go together from frame to frame and view to view."""
_MAX_VOTE_OF_LINK = 3.0
_BEAM = 48
_MAX_BRANCHES = 5
"""Tracks that a piece is tried on, the cheapest."""


class Piece(NamedTuple):
    """A hand in successive frames."""

    start: int
    """The first frame."""
    hands: tuple[PlacedHand, ...]

    @property
    def last(self) -> int:
        """The last frame."""
        return self.start + len(self.hands) - 1

    @property
    def vote(self) -> float:
        """Log odds that it is a right hand."""
        return WEIGHT_OF_VOTES * sum(hand.vote for hand in self.hands)


class Track(NamedTuple):
    """One hand through the take."""

    hands: dict[int, PlacedHand]
    """By frame."""

    @property
    def vote(self) -> float:
        """Log odds that it is a right hand."""
        return WEIGHT_OF_VOTES * sum(hand.vote for hand in self.hands.values())

    @property
    def seen(self) -> int:
        """Number of detections, views times frames."""
        return sum(int((hand.found >= 0).sum()) for hand in self.hands.values())


class Tracks(NamedTuple):
    """All hands of a take."""

    tracks: list[Track]
    unsure: list[tuple[int, int, int]]
    """(frame, track, track): from this frame on, the two could as well be exchanged."""
    jumps: list[tuple[int, int]]
    """(frame, track): there the hand goes on further than `JUMP_M` from where it was expected."""


class _Way(NamedTuple):
    """A way to join the pieces so far."""

    cost: float
    track_of: tuple[int, ...]
    """Of every piece."""
    last: tuple[int, ...]
    """The last piece of every track."""
    votes: tuple[float, ...]
    """Of every track."""


def follow_hands(frames: Iterable[Sequence[PlacedHand]]) -> Tracks:
    """Follow the hands of a take.

    Args:
        frames: The hands of every frame (`match_views`).

    Returns: one track for every hand, false ones among them, in the order of their beginnings.
    """
    pieces = link_frames(frames)
    ways = _ways_to_join(pieces)
    best = ways[0]
    tracks: list[Track] = [Track({}) for _ in best.last]
    for piece, track in zip(pieces, best.track_of, strict=True):
        tracks[track].hands.update({piece.start + i: hand for i, hand in enumerate(piece.hands)})
    before = _predecessors(best.track_of)
    jumps = [
        (piece.start, best.track_of[i])
        for i, piece in enumerate(pieces)
        if (last := before[i]) is not None and _jump_m(pieces[last], piece) > JUMP_M
    ]
    return Tracks(tracks, _unsure_joins(pieces, ways), jumps)


class _OpenPiece:
    """A piece that may go on: what a long take adds a frame to costs the same in every frame."""

    def __init__(self, start: int, hand: PlacedHand) -> None:
        self._start, self._hands = start, [hand]
        self._votes = hand.vote

    def add(self, hand: PlacedHand) -> "_OpenPiece":
        self._hands.append(hand)
        self._votes += hand.vote
        return self

    @property
    def last_two(self) -> Sequence[PlacedHand]:
        return self._hands[-2:]

    @property
    def vote(self) -> float:
        return WEIGHT_OF_VOTES * self._votes

    def closed(self) -> Piece:
        return Piece(self._start, tuple(self._hands))


def link_frames(frames: Iterable[Sequence[PlacedHand]]) -> list[Piece]:
    """Return the runs of frames in which hands can be followed without doubt, by their beginnings."""
    open_pieces: list[_OpenPiece] = []
    closed: list[Piece] = []
    for frame, hands in enumerate(frames):
        links = _links(open_pieces, hands)
        closed += [piece.closed() for i, piece in enumerate(open_pieces) if i not in links]
        taken = {hand: piece for piece, hand in links.items()}
        open_pieces = [
            open_pieces[taken[i]].add(hand) if i in taken else _OpenPiece(frame, hand)
            for i, hand in enumerate(hands)
        ]
    closed += [piece.closed() for piece in open_pieces]
    return sorted(closed, key=lambda piece: (piece.start, piece.last))


def _links(pieces: Sequence[_OpenPiece], hands: Sequence[PlacedHand]) -> dict[int, int]:
    """Return which piece goes on as which hand, without those links that another way nearly equals.

    The table of costs has one more column for every piece (it ends) and one more row for every hand (it
    begins), so that any two entries can be exchanged.
    """
    n, m = len(pieces), len(hands)
    if not n or not m:
        return {}
    table = np.zeros((n + m, n + m))
    table[:n, m:] = table[n:, :m] = MAX_LINK / 2
    table[:n, :m] = [[_link_cost(piece, hand) for hand in hands] for piece in pieces]
    rows, columns = linear_sum_assignment(table)
    chosen = table[rows, columns]
    exchanged = table[rows[:, None], columns[None]] + table[rows[None], columns[:, None]]
    lost = exchanged - chosen[:, None] - chosen[None]
    np.fill_diagonal(lost, np.inf)
    sure = lost.min(1) > SURE_LINK
    return {
        int(row): int(column)
        for row, column, is_sure in zip(rows, columns, sure, strict=True)
        if row < n and column < m and is_sure
    }


def _link_cost(piece: _OpenPiece, hand: PlacedHand) -> float:
    expected = piece.last_two[-1].joints_world + _velocity(piece.last_two)
    sides = cost_of_sides(*(np.clip((piece.vote, hand.vote), -_MAX_VOTE_OF_LINK, _MAX_VOTE_OF_LINK)))
    return mean_distance(expected, hand.joints_world) / MOTION_SCALE_M + sides


def _velocity(hands: Sequence[PlacedHand]) -> Float[Array, "3"]:
    """Return the expected move to the next frame, metres."""
    if len(hands) < 2:
        return np.zeros(3)
    moved = hands[-1].joints_world - hands[-2].joints_world
    moved = moved[np.isfinite(moved).all(-1)]
    return _DAMPING * np.median(moved, axis=0) if len(moved) else np.zeros(3)


def mean_distance(a: Float[Array, "21 3"], b: Float[Array, "21 3"]) -> float:
    """Return the mean distance of the joints that both have, metres; infinite without any."""
    distances = np.linalg.norm(a - b, axis=-1)
    distances = distances[np.isfinite(distances)]
    return float(distances.mean()) if len(distances) else np.inf


def cost_of_sides(a: float, b: float) -> float:
    """Return what it costs that two log odds belong to one hand."""
    return _log_cosh(a / 2) + abs(b) / 2 - _log_cosh((a + b) / 2)


def _log_cosh(x: float) -> float:
    return abs(x) + float(np.log1p(np.exp(-2 * abs(x)))) - float(np.log(2))


def _ways_to_join(pieces: Sequence[Piece]) -> list[_Way]:
    """Return the likeliest ways to join the pieces to tracks, the best first."""
    ways = [_Way(0.0, (), (), ())]
    for number, piece in enumerate(pieces):
        longer = [way for old in ways for way in _continued(old, pieces, number, piece)]
        ways = sorted(longer, key=lambda way: way.cost)[:_BEAM]
    return ways


def _continued(way: _Way, pieces: Sequence[Piece], number: int, piece: Piece) -> list[_Way]:
    """Return the ways in which one more piece can go on."""
    vote = piece.vote
    options = []
    for track, last in enumerate(way.last):
        if pieces[last].last < piece.start:
            cost = _jump_cost(pieces[last], piece) + cost_of_sides(way.votes[track], vote)
            options.append((cost, track))
    options = [*sorted(options)[: _MAX_BRANCHES - 1], (_BIRTH, len(way.last))]
    return [
        _Way(
            way.cost + cost,
            (*way.track_of, track),
            (*way.last[:track], number, *way.last[track + 1 :]),
            (*way.votes[:track], (*way.votes, 0.0)[track] + vote, *way.votes[track + 1 :]),
        )
        for cost, track in options
    ]


def _jump_cost(a: Piece, b: Piece) -> float:
    """Return what it costs that piece b goes on where piece a ended."""
    scale = MOTION_SCALE_M * np.sqrt(b.start - a.last)
    return min(_JUMP_WEIGHT * float(np.log1p(_jump_m(a, b) / scale)), _MAX_JUMP)


def _jump_m(a: Piece, b: Piece) -> float:
    """Return the mean distance of piece b from where piece a was going, and back, metres."""
    gap = b.start - a.last
    ahead = min(gap, _MOST_FRAMES_AHEAD)
    end, begin = a.hands[-1].joints_world, b.hands[0].joints_world
    forward = mean_distance(end + ahead * _velocity(a.hands[-2:]), begin)
    backward = mean_distance(begin + ahead * _velocity(b.hands[1::-1]), end)
    return (forward + backward) / 2


def _unsure_joins(pieces: Sequence[Piece], ways: Sequence[_Way]) -> list[tuple[int, int, int]]:
    """Return where ways nearly as likely as the best leave it: (frame, track, track) of the best way."""
    best = ways[0]
    unsure = []
    for way in ways[1:]:
        if way.cost - best.cost >= SURE_LINK:
            break
        before = _predecessors(way.track_of)
        for number, own in enumerate(_predecessors(best.track_of)):
            if before[number] != own:
                # In the best way, the piece that the other way has before this one is of another track.
                other = before[number] if before[number] is not None else own
                tracks = best.track_of[number], best.track_of[other if other is not None else number]
                unsure.append((pieces[number].start, *sorted(tracks)))
                break
    return sorted(set(unsure))


def _predecessors(track_of: Sequence[int]) -> list[int | None]:
    """Return, for every piece, the piece before it in its track."""
    last: dict[int, int] = {}
    before: list[int | None] = []
    for number, track in enumerate(track_of):
        before.append(last.get(track))
        last[track] = number
    return before
