"""How much earlier or later than the others each camera took its frames, from the motion of the hands.

Letters: camera v's frame that is given for the moment t shows the world at t + tau_v. Its key points at t are
then those given for t - tau_v, found between the frames by a cubic (Catmull and Rom 1974): a straight line
would cut every bend, and shrink what the camera saw. tau is where the key points lie
nearest to each other's epipolar lines. Frames in which nothing moves say nothing.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from poem_jax.calibration.epipolar import fundamental_matrix, ideal_keypoints, median_distance
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Bool, Float, Int

MIN_FRAMES = 4
"""Fewer frames do not tell a motion from a place."""
MAX_FRAMES_OFF = 8.0
"""Offsets beyond it are not looked for."""

_STEP = 0.5
"""Frames between the offsets that are tried first."""
_SWEEPS = 4
_MAX_POINTS = 1000
"""Of a camera, as many as the medians need."""
_LONGEST_RUN = 1000
"""Frames that are looked at, one after the other."""
_LONGEST_GAP = 1.6
"""In usual steps between frames: across a longer one nothing is known of the motion."""

_UNEVEN = 0.2
"""Steps that differ by more are not taken for even, and the points between them for a straight line."""


class TimeOffsets(NamedTuple):
    """What was found, in frames (the median step of the take)."""

    frames: Float[Array, " view"]
    """tau of each camera; their median is zero."""
    error_px: float
    """The largest median distance of a pair of cameras from each other's epipolar lines, offsets undone."""
    given_px: float
    """The same of the frames as given."""


class _Moments(NamedTuple):
    """Key points of the undistorted images through time."""

    points: Float[Array, "view frame point 2"]
    times: Float[Array, " frame"]
    """In frames, growing."""
    picked: Int[Array, " moment"]
    """The frames that are looked at."""


def find_offsets(
    rig: Rig,
    keypoints_px: Float[Array, "frame hand view joint 2"],
    time_s: Float[Array, " frame"] | None = None,
    *,
    view: int | None = None,
) -> TimeOffsets | None:
    """Find the offsets of all cameras, or of the one that alone disagrees.

    Args:
        rig: The cameras.
        keypoints_px: In pixels of the raw images, frames in the order of time; NaN = unseen.
        time_s: When each frame was taken, seconds; None = the frames are evenly spaced.
        view: The camera that may be off; None = any may.

    Returns: None where there are too few frames, or no pair of cameras can be judged.
    """
    if len(keypoints_px) < MIN_FRAMES:
        return None
    window = _most_seen(keypoints_px)
    keypoints_px, time_s = keypoints_px[window], None if time_s is None else time_s[window]
    moments = _moments(rig, keypoints_px, time_s)
    F = {(a, b): fundamental_matrix(rig, a, b) for a in range(rig.num_views) for b in range(rig.num_views)}
    nothing = np.zeros(rig.num_views)
    given = _pair_errors(moments, F, nothing)
    if not np.isfinite(given).any():
        return None
    offsets = _descend(moments, F, nothing, view)
    offsets -= np.median(offsets)
    found = _pair_errors(moments, F, offsets)
    if not np.isfinite(found).any():
        return None
    return TimeOffsets(offsets, float(np.nanmax(found)), float(np.nanmax(given)))


def shifted(
    keypoints_px: Float[Array, "frame hand view joint 2"],
    frames: Float[Array, " view"],
    time_s: Float[Array, " frame"] | None = None,
) -> Float[Array, "frame hand view joint 2"]:
    """Return the key points with the cameras' offsets undone; NaN where a neighbour in time is missing."""
    times = _in_frames(len(keypoints_px), time_s)
    every = np.arange(len(keypoints_px))
    views = [
        _at(keypoints_px[:, :, view], times, every, tau) if tau else keypoints_px[:, :, view]
        for view, tau in enumerate(frames)
    ]
    return np.stack(views, axis=2)


def frame_step_s(time_s: Float[Array, " frame"]) -> float:
    """Return the usual time between two frames, seconds."""
    return float(np.median(np.diff(time_s)))


def _most_seen(keypoints_px: Array) -> slice:
    """Return the run of `_LONGEST_RUN` frames that holds most key points."""
    count = np.cumsum(np.isfinite(keypoints_px).all(-1).sum((1, 2, 3)))
    if len(count) <= _LONGEST_RUN:
        return slice(None)
    inside = count[_LONGEST_RUN:] - count[:-_LONGEST_RUN]
    start = int(inside.argmax()) + 1
    return slice(start, start + _LONGEST_RUN)


def _descend(moments: _Moments, F: dict, offsets: Array, only: int | None) -> Float[Array, " view"]:
    """Find each camera's offset in turn, the others' held, from every start in the first sweep."""
    offsets = offsets.copy()
    reach = min(MAX_FRAMES_OFF, (len(moments.times) - 1) / 3)
    coarse = np.arange(-np.floor(reach / _STEP), np.floor(reach / _STEP) + 1) * _STEP
    for _ in range(_SWEEPS):
        before = offsets.copy()
        # The camera that is worst off moves first; those that it alone spoils then stay.
        errors = _pair_errors(moments, F, offsets)
        order = np.argsort(-np.nan_to_num(_medians(errors)), kind="stable")
        for view in order if only is None else [only]:
            offsets[view] = _best(moments, F, offsets, int(view), coarse)
        if only is not None or np.abs(offsets - before).max() < 0.02:
            break
    return offsets


def _best(moments: _Moments, F: dict, offsets: Array, view: int, coarse: Array) -> float:
    others = [b for b in range(len(offsets)) if b != view]
    there = {b: _moment_points(moments, b, offsets[b]) for b in others}

    def cost(tau: float) -> float:
        here = _moment_points(moments, view, tau)
        errors = [median_distance(F[view, b], here, there[b]) for b in others]
        finite = np.asarray(errors)[np.isfinite(errors)]
        return float(finite.mean()) / _noise_share(tau) if finite.size else np.inf

    costs = np.array([cost(tau) for tau in coarse])
    # As given where another offset is no better: NaN and ties included.
    start = float(coarse[costs.argmin()]) if costs.min() < cost(offsets[view]) else float(offsets[view])
    found: Any = minimize_scalar(cost, bounds=(start - _STEP, start + _STEP), method="bounded")
    return float(found.x) if found.fun < cost(offsets[view]) else float(offsets[view])


def _noise_share(tau: float) -> float:
    """Return how much a mean of frames lessens the noise of a pair of cameras, 0.9 to 1."""
    return float(np.sqrt((1 + sum(weight**2 for weight in _cubic(np.asarray(tau % 1.0)))) / 2))


def _pair_errors(moments: _Moments, F: dict, offsets: Array) -> Float[Array, "view view"]:
    points = [_moment_points(moments, view, tau) for view, tau in enumerate(offsets)]
    count = len(offsets)
    errors = np.full((count, count), np.nan)
    for a in range(count):
        for b in range(a):
            errors[a, b] = errors[b, a] = median_distance(F[a, b], points[a], points[b])
    return errors


def _medians(errors: Float[Array, "view view"]) -> Float[Array, " view"]:
    return np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in errors])


def _moments(rig: Rig, keypoints_px: Array, time_s: Array | None) -> _Moments:
    frames, hands, views, joints, _ = keypoints_px.shape
    ideal = np.moveaxis(ideal_keypoints(rig, keypoints_px), 2, 0).reshape(views, frames, hands * joints, 2)
    count = max(MIN_FRAMES, _MAX_POINTS // max(1, hands * joints))
    picked = np.unique(np.linspace(0, frames - 1, min(frames, count)).astype(int))
    return _Moments(ideal, _in_frames(frames, time_s), picked)


def _in_frames(count: int, time_s: Array | None) -> Float[Array, " frame"]:
    if time_s is None:
        return np.arange(count, dtype=float)
    return (time_s - time_s[0]) / frame_step_s(time_s)


def _moment_points(moments: _Moments, view: int, tau: float) -> Float[Array, "point 2"]:
    return _at(moments.points[view], moments.times, moments.picked, tau).reshape(-1, 2)


def _at(points: Array, times: Array, picked: Int[Array, " moment"], tau: float) -> Array:
    """Return a camera's points (moment, ..., 2) at the picked frames, were its frames not `tau` late."""
    wanted = times[picked] - tau
    after = np.clip(np.searchsorted(times, wanted, side="left"), 1, len(times) - 1)
    before = after - 1
    share = (wanted - times[before]) / (times[after] - times[before])
    usable = _between(share) & (times[after] - times[before] < _LONGEST_GAP)
    share = np.clip(share, 0.0, 1.0).reshape(-1, *[1] * (points.ndim - 1))
    # At a frame itself the neighbours do not matter, and may be unseen.
    straight = np.where(
        share == 0.0,
        points[before],
        np.where(share == 1.0, points[after], (1 - share) * points[before] + share * points[after]),
    )
    steps = np.diff(times)
    outer = np.clip(before - 1, 0, None), np.clip(after + 1, None, len(times) - 1)
    even = (before > 0) & (after < len(times) - 1)
    for side in (before - 1, after):
        step = steps[np.clip(side, 0, len(steps) - 1)]
        even &= np.abs(step / steps[before] - 1) < _UNEVEN
    four = points[outer[0]], points[before], points[after], points[outer[1]]
    curved = sum(weight * point for weight, point in zip(_cubic(share), four, strict=True))
    mixed = np.where(even.reshape(share.shape) & np.isfinite(curved), curved, straight)
    return np.where(usable.reshape(share.shape), mixed, np.nan)


def _cubic(share: Array) -> tuple[Array, Array, Array, Array]:
    """Return the weights of four evenly spaced points, `share` of the way between the middle two."""
    s = share
    return (
        (-s + 2 * s**2 - s**3) / 2,
        (2 - 5 * s**2 + 3 * s**3) / 2,
        (s + 4 * s**2 - 3 * s**3) / 2,
        (s**3 - s**2) / 2,
    )


def _between(share: Array) -> Bool[Array, " moment"]:
    return (share >= 0.0) & (share <= 1.0)
