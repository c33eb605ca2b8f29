"""Which of the hands that were followed to keep, and of which side each is."""

from collections.abc import Sequence

import numpy as np

from poem_jax.capture.hand_tracks import Track
from poem_jax.typing import Array, Float

SIDES = ("right", "left")
SURE_SHARE = 0.7
"""Share of the votes of a hand that must name its side; fewer are a warning."""
SIDE_MARGIN = 0.15
"""Difference of the shares of votes for right that tells which of two hands of one voted side is which."""
PAIR_TOLERANCE = 0.75
"""A right and a left hand are kept rather than two seen more, if they were seen this share as much."""
MIN_SHARE_OF_FRAMES = 0.1
"""Of the frames of the hand seen most: what is seen in fewer is taken for false."""


def trusted_tracks(tracks: Sequence[Track]) -> list[int]:
    """Return the numbers of what was followed long enough to be a hand (`MIN_SHARE_OF_FRAMES`)."""
    most = max(len(track.hands) for track in tracks)
    return [i for i, track in enumerate(tracks) if len(track.hands) >= MIN_SHARE_OF_FRAMES * most]


def kept_tracks(tracks: Sequence[Track], max_hands: int) -> list[int]:
    """Return the numbers of the hands to keep: those followed best.

    Two hands are a right and a left one where such a pair was seen nearly as much as the two seen most
    (`PAIR_TOLERANCE`): of several people, one person's; of several such pairs, that of the nearest hands.
    """
    numbers = sorted(trusted_tracks(tracks), key=lambda i: -tracks[i].seen)
    top = numbers[:max_hands]
    if max_hands != 2 or len(numbers) <= 2:
        return top
    rights = [i for i in numbers if tracks[i].vote > 0]
    lefts = [i for i in numbers if tracks[i].vote <= 0]
    seen = sum(tracks[i].seen for i in top)
    pairs = [
        (_apart(tracks[r], tracks[k]), r, k)
        for r in rights
        for k in lefts
        if tracks[r].seen + tracks[k].seen >= PAIR_TOLERANCE * seen
    ]
    return list(min(pairs)[1:]) if pairs else top


def _apart(a: Track, b: Track) -> float:
    """Return the median distance of two hands, in the frames that have both, metres; infinite without any."""
    both = sorted(set(a.hands) & set(b.hands))
    between = [np.nanmean(a.hands[f].joints_world - b.hands[f].joints_world, axis=0) for f in both]
    return float(np.median(np.linalg.norm(between, axis=-1))) if both else np.inf


def name_sides(
    votes: Sequence[Float[Array, " _"]],
) -> tuple[list[str], list[tuple[str, tuple[int, ...]]]]:
    """Name the side of every hand by the sum of its votes.

    Of exactly two hands with the same side by their votes, of which not both are sure (`SURE_SHARE`), the
    surer one keeps it and the other is of the other side, if their shares differ by `SIDE_MARGIN`.

    Args:
        votes: Of each hand, log odds of the right side.

    Returns: sides, and warnings: messages with a place for the name of every hand in the tuple.
    """
    shares = [_share_for_right(of_hand) for of_hand in votes]
    sides = ["right" if share >= 0.5 else "left" for share in shares]
    unsure = [i for i, share in enumerate(shares) if max(share, 1 - share) < SURE_SHARE]
    warnings: list[tuple[str, tuple[int, ...]]] = []
    if len(sides) == 2 and sides[0] == sides[1]:
        side = sides[0]
        a, b = (share if side == "right" else 1 - share for share in shares)
        share = f"by {a:.0%} and {b:.0%} of the votes"
        check = "check the sides against the images"
        if unsure and abs(shares[0] - shares[1]) >= SIDE_MARGIN:
            sides = ["right", "left"] if shares[0] > shares[1] else ["left", "right"]
            told = f"both hands look {side} ({share}); the less sure one was named the other side: {check}"
        else:
            told = f"both hands are named {side} ({share}): two people's, or the detector is wrong; {check}"
        return sides, [(told, ())]
    for i in unsure:
        most = max(shares[i], 1 - shares[i])
        told = f"the side of the {{}} hand is not sure, {most:.0%} of the votes name it; check it"
        warnings.append((told, (i,)))
    return sides, warnings


def _share_for_right(votes: Float[Array, " n"]) -> float:
    return float(np.maximum(votes, 0).sum() / max(np.abs(votes).sum(), 1e-9))
