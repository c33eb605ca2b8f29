"""Which mistake a rig or its key points show: each known one is undone, and the hands triangulated again.

Three things tell, and each of its own: whether the views agree (camera matrices, pixels), whether the bones
are those of a hand in their proportions (order of the joints), and whether they are of a hand's size (unit of
the rig). A cause is named only where undoing it serves clearly better than undoing any other:
cameras that look at one point from afar are explained almost as well by turned ones.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.calibration.findings import Finding
from poem_jax.calibration.meeting_points import meeting_points, near_rig
from poem_jax.calibration.mistakes import HYPOTHESES, Hypothesis
from poem_jax.calibration.view_agreement import UNEXPLAINED, judge_views
from poem_jax.geometry.cameras import project
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float

MIN_AGREEING = 0.75
"""Of the key points that two views see: where fewer fit the triangulated joints the views disagree."""
PLAUSIBLE_SCALE = (0.43, 1.72)
"""Of hands against an adult one: a palm (wrist to middle knuckle) of 4 to 16 cm."""
MAX_MISFIT = 0.35
"""Root mean square of the logarithms by which the bones' proportions differ from a hand's; people differ by
0.1, detectors add as much, another order of the joints gives 0.5 and more."""

_GATE_SHARE = 0.01
"""Of the images' diagonal, within which a key point fits a triangulated joint."""
_CLEAR_SHARE = 0.15
"""By so much of the key points a cause must explain more than what was given does."""
_CLEAR_ERROR = 0.6
"""So much of the next cause's median error, at most, may remain with the best cause."""
_CLEAR_MISFIT = 0.6
"""So much of the misfit of the given order, at most, may remain in the order that is named."""
_MAX_HANDS = 16
_OPENPOSE = "(wrist, then thumb to little finger, each from its base to its tip)"
_UNITS = {"millimetres": 1e3, "centimetres": 1e2, "inches": 1 / 0.0254, "feet": 1 / 0.3048}


class HandSize(NamedTuple):
    """The bones of an adult hand."""

    bones: tuple[tuple[int, int], ...]
    """Pairs of the joints of a key-point file."""
    lengths_m: Float[Array, " bone"]


class _Trial(NamedTuple):
    hypothesis: Hypothesis | None
    """None = as given."""
    agreeing: float
    """Share of the key points that fit the triangulated joints."""
    error_px: float
    """Median distance of the key points from the triangulated joints; infinity behind a camera."""
    joints_world: Float[Array, "hand 21 3"]
    """NaN where two views do not agree."""


def explain(
    rig: Rig,
    keypoints_px: Float[Array, "frame hand view joint 2"],
    size: HandSize,
    joint_orders: Mapping[str, tuple[int, ...]],
    time_s: Float[Array, " frame"] | None = None,
) -> list[Finding]:
    """Say what is wrong with a rig and its key points; [] = nothing is.

    Args:
        rig: The cameras as read.
        keypoints_px: In pixels of the raw images, NaN = unseen.
        size: What the bones of a hand are like, in the order in which the joints should come.
        joint_orders: Other orders to try: where each joint of the right order stands in the other.
        time_s: When the frames were taken, seconds; None = they are evenly spaced, in the order of time.

    Returns: Findings of what has to be mended first: one of the camera matrices or pixels (named as in
        `HYPOTHESES`), then `joint order`, then `unit of the rig`; or one of `judge_views`, of single cameras;
        or one `views disagree` or `no hand`, where no cause stands out.
    """
    every = np.asarray(keypoints_px, np.float64)
    keypoints_px = _few(every)
    ideal_px = ideal_keypoints(rig, keypoints_px)
    given = _try(None, rig, keypoints_px, ideal_px)
    trial, found = given, []
    if given.agreeing < MIN_AGREEING:
        trials = [_try(mistake, rig, keypoints_px, ideal_px) for mistake in HYPOTHESES]
        likely = _likely(given, trials, size, joint_orders)
        if len(likely) != 1:
            found = judge_views(rig, every, time_s=time_s)
            return [f for f in found if f.name not in UNEXPLAINED] or [_unexplained(given, likely, found)]
        (trial,) = likely
        assert trial.hypothesis is not None
        share = f"{given.agreeing:.0%} of the key points fit each other as given, {trial.agreeing:.0%} so"
        evidence = f"it seems that {trial.hypothesis.cause} ({share})"
        found.append(Finding(trial.hypothesis.name, evidence, trial.hypothesis.fix))
    order, misfit, scale = _shape(trial, size, joint_orders)
    if misfit > MAX_MISFIT:
        return found or [_no_hand(misfit, scale)]
    if order is not None:
        evidence = (
            f"the joints seem to come in the order {order}: only so are the bones those of a hand in their "
            "proportions"
        )
        fix = f"give them in OpenPose's order {_OPENPOSE}"
        found.append(Finding("joint order", evidence, fix))
    if not PLAUSIBLE_SCALE[0] <= scale <= PLAUSIBLE_SCALE[1]:
        found.append(_unit(scale))
    return found


def _likely(
    given: _Trial, trials: list[_Trial], size: HandSize, joint_orders: Mapping[str, tuple[int, ...]]
) -> list[_Trial]:
    """Return the trials in which the views agree on hands, none of them clearly better than another."""
    needed = max(MIN_AGREEING, given.agreeing + _CLEAR_SHARE)
    trials = [trial for trial in trials if trial.agreeing >= needed]
    hands = [trial for trial in trials if _shape(trial, size, joint_orders)[1] <= MAX_MISFIT] or trials
    least = min((trial.error_px for trial in hands), default=np.inf)
    return [trial for trial in hands if _CLEAR_ERROR * trial.error_px <= least]


def _try(hypothesis: Hypothesis | None, rig: Rig, keypoints_px: Array, given_ideal_px: Array) -> _Trial:
    """Triangulate the hands with a mistake undone; most leave the undistorted pixels as given."""
    given, given_px = rig, keypoints_px
    if hypothesis is not None:
        rig, keypoints_px = hypothesis.undo(rig, keypoints_px)
    same = rig.K is given.K and rig.dist is given.dist and keypoints_px is given_px
    ideal = given_ideal_px if same else ideal_keypoints(rig, keypoints_px)
    ideal = ideal.reshape(-1, *ideal.shape[2:])
    near, extent = near_rig(rig)
    points, valid = meeting_points(near, ideal)
    uv, depth = project(rig.K, near.T_cam_from_world, points[:, None])
    gate = _GATE_SHARE * float(np.linalg.norm(rig.size_wh, axis=-1).mean())
    # Points that no ray reaches count as seen: a mistake is not undone by losing them.
    seen = np.isfinite(keypoints_px).all(-1).reshape(ideal.shape[:-1])
    counted = seen & (seen.sum(1, keepdims=True) >= 2)
    distance = np.linalg.norm(uv - np.nan_to_num(ideal), axis=-1)
    fits = counted & valid[:, None] & (depth > 0) & (distance < gate)
    good = valid & (fits == counted).all(1) & counted.any(1)
    if not counted.any():
        return _Trial(hypothesis, 0.0, np.inf, np.full_like(points, np.nan))
    error = np.median(np.where(valid[:, None] & (depth > 0), distance, np.inf)[counted])
    joints = np.where(good[..., None], extent * points, np.nan)
    return _Trial(hypothesis, float(fits[counted].mean()), float(error), joints)


def _shape(
    trial: _Trial, size: HandSize, joint_orders: Mapping[str, tuple[int, ...]]
) -> tuple[str | None, float, float]:
    """Return the order of the joints (None = the right one), the bones' misfit in it, and their scale."""
    misfit, scale = _bones(trial.joints_world, size)
    others = {name: _bones(trial.joints_world[:, list(order)], size) for name, order in joint_orders.items()}
    if misfit <= MAX_MISFIT / 2 or not others:
        return None, misfit, scale
    best = min(others, key=lambda name: others[name][0])
    if others[best][0] <= _CLEAR_MISFIT * misfit:
        return best, *others[best]
    return None, misfit, scale


def _bones(joints_world: Float[Array, "hand 21 3"], size: HandSize) -> tuple[float, float]:
    """Return how much the proportions of the bones, and their size, differ from a hand's."""
    a, b = np.array(size.bones).T
    lengths = np.linalg.norm(joints_world[:, a] - joints_world[:, b], axis=-1)
    known = np.isfinite(lengths).any(0)
    if 2 * known.sum() < len(known):
        return np.inf, np.nan
    ratio = np.log(np.maximum(np.nanmedian(lengths[:, known], 0), 1e-12) / size.lengths_m[known])
    return float(ratio.std()), float(np.exp(np.median(ratio)))


def _unit(scale: float) -> Finding:
    unit = next((name for name, factor in _UNITS.items() if 0.6 < scale / factor < 1.6), None)
    evidence = (
        f"the rig's lengths are not metres: the hands come out {scale:.3g} times as large as adult ones. If "
        f"they are adult, one unit of the rig is about {1000 / scale:.2g} mm of what it says it is"
    )
    fix = "correct `unit`, or scale every `t`"
    return Finding("unit of the rig", evidence + (f" ({unit}?)" if unit else ""), fix)


def _unexplained(given: _Trial, likely: list[_Trial], views: list[Finding]) -> Finding:
    causes = "; or ".join(trial.hypothesis.cause for trial in likely if trial.hypothesis is not None)
    return Finding(
        "views disagree",
        f"the rig does not fit the key points: only {given.agreeing:.0%} of them fit what the views "
        f"triangulate, and {'it may be that ' + causes if causes else 'no known mistake explains it'}"
        + "".join(f"; {finding.evidence}" for finding in views),
        "check that K belongs to the images as they are, that x_cam = R @ x_world + t in OpenCV axes, that "
        "the key points are in pixels of the raw images, and that they are in the rig's order of cameras",
        fatal=False,
    )


def _no_hand(misfit: float, scale: float) -> Finding:
    return Finding(
        "no hand",
        "the views agree, but the bones are not those of a hand in any known order of its joints: their "
        f"proportions are off by a factor of {np.exp(misfit):.2g}, their size by {scale:.2g}",
        f"check that the joints are in OpenPose's order {_OPENPOSE}, all of one hand, and that the terms "
        "of the lens are right",
        fatal=False,
    )


def _few(keypoints_px: Array) -> Array:
    """Return the hands, at most `_MAX_HANDS`, as frames of one hand each: those that most views see."""
    hands = keypoints_px.reshape(-1, 1, *keypoints_px.shape[2:])
    count = np.isfinite(hands).all(-1).sum((1, 2, 3))
    return hands[np.sort(np.argsort(-count, kind="stable")[:_MAX_HANDS])]
