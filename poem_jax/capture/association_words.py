"""What is said of an association that is not sure: what, where, and what to do.

`called` are the names of the frames.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from poem_jax.capture.hand_choice import SIDES
from poem_jax.capture.hand_matching import PlacedHand
from poem_jax.capture.hand_tracks import Track, Tracks
from poem_jax.capture.sightings import NONE, SAME_HAND_M, Sightings, ray_distances
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Bool, Int

_MOST_NAMED = 5
_OFTEN = 0.2
"""Share of the frames in which several cameras see what does not meet: more than now and then."""


def unsure_matches(followed: Tracks, named: dict[int, str], rig: Rig, called: Sequence[str]) -> list[str]:
    """Name the views of which another detection fits a hand as well."""
    places: dict[tuple[str, int], list[int]] = {}
    for number, name in named.items():
        for frame, hand in followed.tracks[number].hands.items():
            for view in hand.unsure_views:
                places.setdefault((name, view), []).append(frame)
    return [
        f"camera {rig.names[view]} may show another hand as the {name} one in {listed(frames, called)}: its "
        "rays fit badly, or those of both hands fit equally well; check these images"
        for (name, view), frames in sorted(places.items())
    ]


def unsure_tracks(followed: Tracks, named: dict[int, str], called: Sequence[str]) -> list[str]:
    """Name the frames from which on hands could be exchanged."""
    told = []
    for frame, *pair in followed.unsure:
        hands = sorted({named[i] for i in pair if i in named})
        if hands:
            told.append(
                f"hands may be exchanged from frame {called[frame]} on ({' and '.join(hands)}): place, "
                "motion and sides fit another way nearly as well; check the images before and after"
            )
    return told


def suspicious_jumps(followed: Tracks, named: dict[int, str], called: Sequence[str]) -> list[str]:
    """Name the hands that go on elsewhere, where several people's hands may be mixed up."""
    rights = [track.vote > 0 for track in followed.tracks]
    return [
        f"the {named[i]} hand goes on far from where it was in frame {called[frame]}, and other {side} hands "
        "are there: it could be another person's from then on; check the images before and after"
        for frame, i in followed.jumps
        if i in named and rights.count(rights[i]) > 1
        for side in (SIDES[0] if rights[i] else SIDES[1],)
    ]


def others(tracks: Sequence[Track], kept: Sequence[int], max_hands: int, called: Sequence[str]) -> list[str]:
    """Tell of what was followed and is not kept."""
    rest = [track for i, track in enumerate(tracks) if i not in kept]
    if not rest:
        return []
    frames = listed(sorted({frame for track in rest for frame in track.hands}), called)
    if len(kept) < max_hands:
        return [
            f"something like one more hand was seen in {frames}, too short a time to be trusted, and left "
            "out; check these images if a hand is missing there"
        ]
    return [
        f"other hands than the {len(kept)} kept were seen, in {frames}, and left out; if they are wanted "
        f"give a larger `--max-hands` (now {max_hands}); where few views see the kept ones, check that they "
        "are not mixed up with others"
    ]


def doubtful_lone(doubtful: Sequence[tuple[int, int]], rig: Rig, called: Sequence[str]) -> list[str]:
    """Name the detections of one view that could be of either of two hands."""
    return [
        f"camera {rig.names[view]} alone sees a hand in {listed(frames, called)} that could be either of "
        "two: it is left out there: check these images"
        for view in sorted({view for _, view in doubtful})
        for frames in ([frame for frame, seen_by in doubtful if seen_by == view],)
    ]


def unconfirmed(
    frames: Sequence[Sightings],
    found: Int[Array, "hand frame view"],
    tracks: Sequence[Track],
    rig: Rig,
    called: Sequence[str],
) -> list[str]:
    """Name the views that see what no other view confirms, second detections of a hand left out."""
    places: dict[int, list[int]] = {}
    for frame, sightings in enumerate(frames):
        hands = [track.hands[frame] for track in tracks if frame in track.hands]
        used = np.concatenate([found[:, frame].ravel(), *(hand.found for hand in hands)])
        free = np.setdiff1d(np.arange(len(sightings.view)), used)
        for number in free[~_are_second(sightings, hands, free)]:
            places.setdefault(int(sightings.view[number]), []).append(frame)
    told = [
        f"{rig.names[view]} in {listed(sorted(set(where)), called)}" for view, where in sorted(places.items())
    ]
    in_several = Counter(frame for where in places.values() for frame in set(where))
    often = sum(views > 1 for views in in_several.values()) > _OFTEN * len(frames)
    return [
        f"what looks like a hand to one camera and has no place in space is left out ({'; '.join(told)}): "
        "look at these images if a hand is missing there"
    ] * bool(told) + [
        "several cameras see hands that do not meet in space: they may be another person's, and mixed up "
        "with those kept; give a larger `--max-hands` if more people are seen, and check the overlays"
    ] * often


def _are_second(
    sightings: Sightings, hands: Sequence[PlacedHand], numbers: Int[Array, " n"]
) -> Bool[Array, " n"]:
    """Tell which detections show a hand of which their view has another one."""
    second = np.zeros(len(numbers), dtype=bool)
    for hand in hands:
        near = ray_distances(sightings, hand.joints_world)[numbers] < SAME_HAND_M
        second |= near & (hand.found[sightings.view[numbers]] != NONE)
    return second


def listed(frames: Sequence[int], called: Sequence[str]) -> str:
    """Return frames in words, the first few by name."""
    first = ", ".join(called[frame] for frame in frames[:_MOST_NAMED])
    if len(frames) <= _MOST_NAMED:
        return f"frame{'s' * (len(frames) > 1)} {first}"
    return f"{len(frames)} frames ({first}, ...)"
