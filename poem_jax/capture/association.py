"""The same hand in all cameras and frames, from where its rays meet and not from the detector's side alone.

Views are matched frame by frame (`hand_matching`), hands followed through the take (`hand_tracks`), and the
detections of frames in which a hand is seen by one view only are joined to the track that expects them.
Whatever is not sure is said in `warnings`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from poem_jax.calibration.view_agreement import UNEXPLAINED
from poem_jax.capture import association_words as words
from poem_jax.capture.calibration_check import check_calibration
from poem_jax.capture.detections import within_images
from poem_jax.capture.hand_choice import SIDES, kept_tracks, name_sides, trusted_tracks
from poem_jax.capture.hand_matching import match_views
from poem_jax.capture.hand_tracks import Track, follow_hands
from poem_jax.capture.hands_by_side import hands_by_side
from poem_jax.capture.lone_detections import join_lone_detections
from poem_jax.capture.sightings import NONE, Sightings, SightingsOfFrames
from poem_jax.data.capture_folder import hand_names
from poem_jax.detection import DetectedHand
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.world_origin import distant_origin, move_origin
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.typing import Array, Float, Int


class AssociatedHands(NamedTuple):
    """The hands of a take: right before left, then by how much they were seen."""

    keypoints_px: Float[Array, "frame hand view 21 2"]
    """Raw pixels as given; NaN = unseen."""
    score: Float[Array, "frame hand view"]
    """Of the detections, 0.5 to 1; NaN = unseen."""
    hand_side: tuple[str, ...]
    """`right` or `left`."""
    warnings: tuple[str, ...]
    """What is not sure: what, where, and what to do."""


_Found = Int[Array, "hand frame view"]


def associate_hands(
    detections: Sequence[Sequence[Sequence[DetectedHand]]],
    rig: Rig,
    *,
    max_hands: int = 2,
    frame_names: Sequence[str] | None = None,
) -> AssociatedHands:
    """Find which detections are the same hand in all views and frames, and of which side each hand is.

    A hand must be seen by two views at once somewhere in the take, to have a place; where only one camera
    sees hands at all, its detections are taken by their sides alone, with a warning.

    Args:
        detections: By frame, view (in the rig's order) and hand found; pixels of the raw images.
        rig: The cameras.
        max_hands: Hands returned at most, those followed best: 2 for one person.
        frame_names: By which warnings call the frames; None = their numbers from 0.

    Returns: see `AssociatedHands`. A second detection of one hand in one view, and what fits no hand, is left
        out.

    Raises:
        ValueError: Views are not the rig's, `max_hands` is not positive, nothing was found, or no two views
            agree on any hand.
    """
    _check(detections, rig, max_hands)
    called = [str(i) for i in range(len(detections))] if frame_names is None else frame_names
    seeing = {view for views in detections for view, found in enumerate(views) if found}
    if len(seeing) == 1:
        return _of_one_camera(detections, rig, seeing.pop(), max_hands, called)
    near = move_origin(rig.T_cam_from_world, distant_origin(rig.T_cam_from_world))
    frames = SightingsOfFrames(detections, rig._replace(T_cam_from_world=near))
    followed = follow_hands(match_views(frame, max_hands) for frame in frames)
    if not followed.tracks:
        raise ValueError(_why_none_agree(detections, rig))
    kept = kept_tracks(followed.tracks, max_hands)
    # Hands that are not kept hold their detections too, so that nobody else takes them.
    trusted = trusted_tracks(followed.tracks)
    found = _table([followed.tracks[i] for i in trusted], len(frames), rig.num_views)
    every, doubtful = join_lone_detections(frames, [followed.tracks[i] for i in trusted], found)
    found = every[[trusted.index(i) for i in kept]]
    sides, of_sides = name_sides(_votes(frames, found))
    order = sorted(range(len(kept)), key=lambda i: (SIDES.index(sides[i]), -(found[i] != NONE).sum()))
    names = hand_names(tuple(sides[i] for i in order))
    named = {kept[i]: name for i, name in zip(order, names, strict=True)}
    warnings = [
        *(message.format(*(names[order.index(i)] for i in hands)) for message, hands in of_sides),
        *words.unsure_matches(followed, named, rig, called),
        *words.unsure_tracks(followed, named, called),
        *words.suspicious_jumps(followed, named, called),
        *words.others(followed.tracks, kept, max_hands, called),
        *words.doubtful_lone(doubtful, rig, called),
        *words.unconfirmed(frames, every, followed.tracks, rig, called),
    ]
    keypoints, scores = _entries(detections, frames, found[order])
    return AssociatedHands(keypoints, scores, tuple(sides[i] for i in order), tuple(warnings))


def _check(detections: Sequence[Sequence[Sequence[DetectedHand]]], rig: Rig, max_hands: int) -> None:
    if max_hands < 1:
        raise ValueError(f"`max_hands` must be 1 or more; got {max_hands}")
    for frame, views in enumerate(detections):
        if len(views) != rig.num_views:
            raise ValueError(
                f"`detections` must hold the {rig.num_views} views of the rig ({', '.join(rig.names)}) in "
                f"every frame; frame {frame} has {len(views)}"
            )
    if not any(found for views in detections for found in views):
        raise ValueError(
            f"no hand was found in any image of {len(detections)} frames and {rig.num_views} views; check "
            "that the images show hands, upright and lit, or give boxes or key points instead"
        )


def _table(tracks: Sequence[Track], num_frames: int, num_views: int) -> _Found:
    found = np.full((len(tracks), num_frames, num_views), NONE)
    for row, track in zip(found, tracks, strict=True):
        for frame, hand in track.hands.items():
            row[frame] = hand.found
    return found


def _votes(frames: Sequence[Sightings], found: _Found) -> list[Float[Array, " _"]]:
    """Return the votes of all detections of every hand."""
    votes: list[list[Array]] = [[np.zeros(0)] for _ in found]
    for number, frame in enumerate(frames):
        for of_hand, row in zip(votes, found[:, number], strict=True):
            of_hand.append(frame.votes[row[row != NONE]])
    return [np.concatenate(of_hand) for of_hand in votes]


def _entries(
    detections: Sequence[Sequence[Sequence[DetectedHand]]], frames: Sequence[Sightings], found: _Found
) -> tuple[Float[Array, "frame hand view 21 2"], Float[Array, "frame hand view"]]:
    """Return key points and scores of the chosen detections."""
    num_hands, num_frames, num_views = found.shape
    keypoints = np.full((num_frames, num_hands, num_views, NUM_JOINTS, 2), np.nan)
    scores = np.full((num_frames, num_hands, num_views), np.nan)
    for frame, (views, sightings) in enumerate(zip(detections, frames, strict=True)):
        for hand, view in np.argwhere(found[:, frame] != NONE):
            chosen = views[view][sightings.number[found[hand, frame, view]]]
            keypoints[frame, hand, view], scores[frame, hand, view] = chosen.keypoints_px, chosen.score
    return keypoints, scores


def _of_one_camera(
    detections: Sequence[Sequence[Sequence[DetectedHand]]],
    rig: Rig,
    view: int,
    max_hands: int,
    called: Sequence[str],
) -> AssociatedHands:
    """Return the hands of the only camera that sees any."""
    hands = hands_by_side(detections, rig.num_views, max_hands)
    warnings = [
        f"only camera {rig.names[view]} sees hands: they are told apart by the detector's side alone, which "
        "no second view confirms; check the sides"
    ]
    if hands.doubled:
        warnings.append(
            f"camera {rig.names[view]} sees several hands of one side in "
            f"{words.listed(hands.doubled, called)}; the surest was kept: check these images"
        )
    return AssociatedHands(hands.keypoints_px, hands.score, hands.hand_side, tuple(warnings))


def _why_none_agree(detections: Sequence[Sequence[Sequence[DetectedHand]]], rig: Rig) -> str:
    """Say that nothing meets, and what is wrong with the rig if its hands by side tell."""
    seen = within_images(hands_by_side(detections, rig.num_views).keypoints_px, rig)
    met = np.isfinite(seen).all(-1).any(-1).sum(-1) > 1
    found = [finding for finding in check_calibration(rig, seen) if finding.name not in UNEXPLAINED]
    why = "check the rig, that frames are synchronous and views in its order"
    if met.any() and found:
        why = str(min(found, key=lambda finding: not finding.fatal))
    cameras = ", ".join(rig.names)
    return f"no two of the cameras {cameras} agree on a hand in any frame, though hands were found: {why}"
