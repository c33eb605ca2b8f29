"""Which cameras do not show what the others show, and why: exchanged, mirrored, turned or copied images, a
wrong lens, another moment, or a camera that was moved.

What tells is the distance of key points from each other's epipolar lines. A cause is named where undoing it
brings all pairs of cameras together and undoing no other does; otherwise the pairs are named that disagree.
Causes that need nothing to be estimated come first, a new place of a camera, which explains nearly all, last.
"""

from itertools import combinations

import numpy as np

from poem_jax.calibration.epipolar import (
    epipolar_distances_px,
    ideal_keypoints,
)
from poem_jax.calibration.exchanged_images import exchanged_or_flipped, worst_px
from poem_jax.calibration.findings import Finding
from poem_jax.calibration.lens_mistakes import judge_lens
from poem_jax.calibration.one_camera import LoneCamera, explain_camera
from poem_jax.calibration.time_offsets import find_offsets
from poem_jax.calibration.time_words import LATE_FRAMES, late_cameras
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float

SUSPICIOUS_SHARE = 0.006
"""Of the diagonal of the images: a median epipolar distance beyond it is more than detectors' noise. Chosen
between the 0.3 % of usable rigs and the 0.7 % of a bad one, on four captures."""
UNEXPLAINED = ("one view disagrees", "views disagree")
"""Names of the findings that say only that views disagree, not why."""
MAX_EXCHANGED_VIEWS = 12
"""Of more views no cause is looked for, as the time grows with the fourth power of their number."""
_MAX_NAMED = 6
"""Pairs of cameras in a message."""
_MAX_POINTS = 2000
_COPIED_SHARE = 0.1
"""Of a hand's extent in the image: key points of two cameras nearer to each other than this are of one
image."""
_CLEAR = 2.0
"""A cause must leave half the distance that any other cause leaves."""
_TIME_IS_ENOUGH = 1.3
"""Offsets in time are named where they leave so much more than the best place of one camera, at most."""


def judge_views(
    rig: Rig,
    keypoints_px: Float[Array, "frame hand view joint 2"],
    *,
    extent_share: float = 0.0,
    time_s: Float[Array, " frame"] | None = None,
) -> list[Finding]:
    """Say which cameras' key points do not fit together, and the cause where it is clear; [] = all is well.

    Args:
        rig: The cameras.
        keypoints_px: In pixels of the raw, distorted images; NaN = unseen. Given by a user, or predicted by a
            network from the images; one joint or 21.
        extent_share: How far key points may be off as a share of the hand's extent in the images, beyond
            the noise of a detector; for the predictions of networks.
        time_s: When the frames were taken, seconds; None = they are evenly spaced, in the order of time.

    Returns: At most one finding, of the name `copied images`, `flipped image`, `cameras exchanged`, one of a
        lens (`lens_mistakes.NAMES`), `time offset`, `camera moved` or a mistake's (`mistakes.HYPOTHESES`) of
        one camera, `one view disagrees` or `views disagree`.
    """
    every = np.asarray(keypoints_px, np.float64)
    keypoints_px = spread_frames(every)
    ideal = ideal_keypoints(rig, keypoints_px)
    limit = SUSPICIOUS_SHARE * float(np.linalg.norm(rig.size_wh, axis=-1).mean())
    limit = max(limit, extent_share * _extent(keypoints_px))
    distances = epipolar_distances_px(rig, ideal)
    if not (distances > limit).any():
        return []
    copied = _copied(rig, keypoints_px, distances, limit)
    if copied:
        return copied
    causes = exchanged_or_flipped(rig, keypoints_px) if rig.num_views <= MAX_EXCHANGED_VIEWS else ()
    fitting = [(cost, finding) for cost, finding in causes if cost <= limit]
    fitting.sort(key=lambda pair: pair[0])
    if fitting and (len(fitting) == 1 or fitting[1][0] > _CLEAR * fitting[0][0]):
        return [fitting[0][1]]
    if rig.num_views <= MAX_EXCHANGED_VIEWS:
        lens = judge_lens(rig, keypoints_px, limit)
        if lens:
            return lens
    view = _alone(distances, limit)
    cause = None if view is None else explain_camera(rig, keypoints_px, view, limit)
    if cause is not None and cause.known:
        return [cause.finding]
    late = _late(rig, every, time_s, view, cause, limit)
    if late:
        return late
    if view is None:
        return [_pairs(rig, distances, limit)]
    return [_lone(rig, distances, limit, view) if cause is None else cause.finding]


def _late(
    rig: Rig,
    keypoints_px: Array,
    time_s: Array | None,
    view: int | None,
    cause: LoneCamera | None,
    limit: float,
) -> list[Finding]:
    """Name cameras that took their frames earlier or later, where this explains about all."""
    if rig.num_views > MAX_EXCHANGED_VIEWS:
        return []
    offsets = find_offsets(rig, keypoints_px, time_s, view=view)
    if offsets is None or offsets.error_px > limit or np.abs(offsets.frames).max() < LATE_FRAMES:
        return []
    if cause is not None:
        moved = worst_px(
            epipolar_distances_px(cause.rig, ideal_keypoints(cause.rig, spread_frames(keypoints_px)))
        )
        if offsets.error_px > _TIME_IS_ENOUGH * moved:
            return []
    return [late_cameras(rig, offsets, time_s)]


def _copied(
    rig: Rig, keypoints_px: Array, distances: Float[Array, "view view"], limit: float
) -> list[Finding]:
    """Tell views with the same key points, though their cameras stand apart."""
    by_view = np.moveaxis(keypoints_px, 2, 0)
    same = max(2.0, _COPIED_SHARE * _extent(keypoints_px))
    for a, b in combinations(range(rig.num_views), 2):
        distance = np.linalg.norm(by_view[a] - by_view[b], axis=-1)
        alike = np.isfinite(distance).any() and np.nanmedian(distance) < same
        if alike and _one_is_wrong(a, b, distances, limit):
            evidence = (
                f"cameras '{rig.names[a]}' and '{rig.names[b]}' show the hands at the same pixels "
                f"({np.nanmedian(distance):.0f} px apart), which cameras at different places do not: "
                "one image seems to be copied"
            )
            return [Finding("copied images", evidence, "give every camera its own image")]
    return []


def _one_is_wrong(a: int, b: int, distances: Float[Array, "view view"], limit: float) -> bool:
    """Tell whether two views disagree with each other, or one of them with most others and the other not.

    Cameras side by side show much the same, and are both apart from a third that is wrong.
    """
    others = np.delete(distances[[a, b]], [a, b], axis=1)
    counted = np.isfinite(others).sum(1)
    first, second = 2 * (others > limit).sum(1) > counted
    return bool(distances[a, b] > limit or first != second)


def _alone(distances: Array, limit: float) -> int | None:
    """Return the one view that disagrees, where the others agree with each other."""
    count = len(distances)
    apart = distances > limit
    agree = [~np.delete(np.delete(apart, view, 0), view, 1).any() for view in range(count)]
    return agree.index(True) if count > 2 and sum(agree) == 1 else None


def _lone(rig: Rig, distances: Array, limit: float, view: int) -> Finding:
    others = ", ".join(f"'{name}'" for name in rig.names if name != rig.names[view])
    evidence = (
        f"the key points of these cameras do not fit together: {_named_pairs(rig, distances, limit)}; "
        f"without '{rig.names[view]}' the others ({others}) agree, so its image, its place or its "
        "calibration is wrong, or it is black, covered, or of another moment"
    )
    fix = f"correct '{rig.names[view]}', or leave it out"
    return Finding("one view disagrees", evidence, fix, fatal=False)


def _pairs(rig: Rig, distances: Array, limit: float) -> Finding:
    return Finding(
        "views disagree",
        f"the key points of these cameras do not fit together: {_named_pairs(rig, distances, limit)}. "
        "Calibration, order of the cameras, or frames that are not of one moment?",
        "the results are not to be trusted to the millimetre",
        fatal=False,
    )


def _named_pairs(rig: Rig, distances: Array, limit: float) -> str:
    pairs = [pair for pair in combinations(range(rig.num_views), 2) if distances[pair] > limit]
    named = ", ".join(
        f"'{rig.names[a]}' and '{rig.names[b]}' {distances[a, b]:.0f} px"
        for a, b in sorted(pairs, key=lambda pair: -distances[pair])[:_MAX_NAMED]
    )
    named += f" and {len(pairs) - _MAX_NAMED} pairs more" if len(pairs) > _MAX_NAMED else ""
    return f"{named} off each other's epipolar lines (median; expected below {limit:.0f} px)"


def _extent(keypoints_px: Array) -> float:
    """Return the median length of the diagonal of a hand's key points in an image; 0 for single joints."""
    seen = np.isfinite(keypoints_px).all(-1).any(-1)
    hands = keypoints_px[seen]
    if not len(hands):
        return 0.0
    return float(np.median(np.linalg.norm(np.nanmax(hands, -2) - np.nanmin(hands, -2), axis=-1)))


def spread_frames(
    keypoints_px: Float[Array, "frame hand view joint 2"],
) -> Float[Array, "kept hand view joint 2"]:
    """Return key points of frames spread over the take, no more than the medians need."""
    frames, hands, _, joints, _ = keypoints_px.shape
    kept = max(1, _MAX_POINTS // max(1, hands * joints))
    return keypoints_px[np.unique(np.linspace(0, frames - 1, min(frames, kept)).astype(int))]
