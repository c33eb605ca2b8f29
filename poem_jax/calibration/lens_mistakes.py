"""Whether the lens terms of a rig are those of its key points: left out, of the wrong sign, or used twice.

The middle of an image hardly shows its lens, so the distances that a wrong one gives are often below those
that a detector gives. What tells is that most hands fit better with it mended, and by how much.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from poem_jax.calibration.epipolar import pair_distances_px
from poem_jax.calibration.findings import Finding
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float

NAMES = ("lens left out", "lens used twice", "sign of the lens")
"""Of the findings."""
MIN_HANDS = 6
"""Hands in single frames, below which nothing is said."""

_CAP_SHARE = 0.04
"""Of the images' diagonal, beyond which a distance counts for no more."""
_REMAINS = 0.8
"""So much of the mean distance, at most, may remain with the lens mended. On four captures undoing a mistake
leaves 0.4 to 0.65, and terms estimated where there are none 0.9 and more."""
_HANDS_THAT_GAIN = 0.8
"""Share of the hands that must fit better: a few at an edge may do so by chance."""
_RANGE = (-0.6, 0.6)
"""Of k1, where it is estimated."""
_SWEEPS = 2


class _Trial(NamedTuple):
    rig: Rig
    name: str
    cause: str
    fix: str


def judge_lens(
    rig: Rig, keypoints_px: Float[Array, "frame hand view joint 2"], limit_px: float = np.inf
) -> list[Finding]:
    """Say what is wrong with the lens terms; [] = nothing is, or too few hands show it.

    Args:
        rig: The cameras.
        keypoints_px: In pixels of the images as they are; NaN = unseen.
        limit_px: With the lens mended no pair of cameras may have a larger median distance.

    Returns: At most one finding, of a name in `NAMES`.
    """
    cap_px = _CAP_SHARE * float(np.linalg.norm(rig.size_wh, axis=-1).mean())
    given = _hand_costs(rig, keypoints_px, cap_px)
    if np.isfinite(given).sum() < MIN_HANDS:
        return []
    best: tuple[float, Finding] | None = None
    for trial in _trials(rig, keypoints_px, cap_px):
        mended = _hand_costs(trial.rig, keypoints_px, cap_px)
        cost = float(np.nanmean(mended))
        if not _is_better(given, mended) or _worst_px(trial.rig, keypoints_px, cap_px) > limit_px:
            continue
        if best is None or cost < best[0]:
            evidence = (
                f"{trial.cause}: with it mended the key points lie {cost:.1f} px off each other's epipolar "
                f"lines, as given {np.nanmean(given):.1f} px (mean of {np.isfinite(given).sum()} hands)"
            )
            best = cost, Finding(trial.name, evidence, trial.fix, fatal=False)
    return [] if best is None else [best[1]]


def _trials(rig: Rig, keypoints_px: Array, cap_px: float) -> Iterator[_Trial]:
    has_lens = rig.dist.any(-1)
    if has_lens.any():
        yield _Trial(
            rig._replace(dist=np.zeros_like(rig.dist)),
            "lens used twice",
            "the key points seem to be of undistorted images already, while the rig has the lens's terms",
            "leave the distortion out (zeros), or give key points of the raw images",
        )
        yield _Trial(
            rig._replace(dist=-rig.dist),
            "sign of the lens",
            "the lens's terms seem to have the wrong sign",
            "negate them, or write those of the model that maps ideal to raw points, as OpenCV's does",
        )
    if not has_lens.all():
        without = np.flatnonzero(~has_lens)
        estimated = _with_estimated_lens(rig, keypoints_px, without, cap_px)
        named = ", ".join(f"'{rig.names[view]}' k1 = {estimated.dist[view, 0]:.2f}" for view in without)
        yield _Trial(
            estimated,
            "lens left out",
            f"the images seem to be distorted, while the rig has no terms of the lens (estimated: {named})",
            "write the distortion that was calibrated, or undistort the images",
        )


def _with_estimated_lens(rig: Rig, keypoints_px: Array, views: Array, cap_px: float) -> Rig:
    """Return the rig with the k1 that fits best: of all views alike first, then of each in turn."""
    for group in (views, *([view] for _ in range(_SWEEPS) for view in views)):

        def cost(k1: float, rig: Rig = rig, group: Array = group) -> float:
            return float(np.nanmean(pair_distances_px(_with_k1(rig, group, k1), keypoints_px, cap_px)))

        found: Any = minimize_scalar(cost, bounds=_RANGE, method="bounded", options={"xatol": 0.01})
        rig = _with_k1(rig, group, float(found.x)) if found.fun < cost(rig.dist[group[0], 0]) else rig
    return rig


def _with_k1(rig: Rig, views: Array, k1: float) -> Rig:
    dist = rig.dist.copy()
    dist[views, 0] = k1
    return rig._replace(dist=dist)


def _hand_costs(rig: Rig, keypoints_px: Array, cap_px: float) -> Float[Array, " hand"]:
    """Return the mean distance of each hand in each frame; NaN where no two views see it."""
    distances = np.moveaxis(pair_distances_px(rig, keypoints_px, cap_px), 0, 2)
    distances = distances.reshape(-1, distances.shape[2] * distances.shape[3])
    count = np.isfinite(distances).sum(-1)
    return np.where(count > 0, np.nansum(distances, -1) / np.maximum(count, 1), np.nan)


def _worst_px(rig: Rig, keypoints_px: Array, cap_px: float) -> float:
    """Return the largest median distance of a pair of cameras."""
    pairs = pair_distances_px(rig, keypoints_px, cap_px)
    return max((float(np.nanmedian(pair)) for pair in pairs if np.isfinite(pair).any()), default=np.inf)


def _is_better(given: Array, mended: Array) -> bool:
    """Tell whether the hands fit clearly better, and not by a few alone."""
    gain = (given - mended)[np.isfinite(given)]
    return bool(np.nanmean(mended) < _REMAINS * np.nanmean(given) and (gain > 0).mean() >= _HANDS_THAT_GAIN)
