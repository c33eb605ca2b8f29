"""Which mistake a rig or its key points show: each known one is undone, and the hands triangulated again.

Three things tell, and each of its own: whether the views agree (camera matrices, pixels), whether the bones
are those of a hand in their proportions (order of the joints), and whether they are of a hand's size (unit of
the rig). A cause is named only where undoing it serves clearly better than undoing any other:
cameras that look at one point from afar are explained almost as well by turned ones.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.calibration.findings import Finding
from poem_jax.calibration.view_agreement import CAUSES, judge_views
from poem_jax.geometry.cameras import project
from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.geometry.transforms import invert_rigid, rigid
from poem_jax.typing import Array, Bool, Float

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
_MAX_HANDS = 24
_OPENPOSE = "(wrist, then thumb to little finger, each from its base to its tip)"
_UNITS = {"millimetres": 1e3, "centimetres": 1e2, "inches": 1 / 0.0254, "feet": 1 / 0.3048}


class HandSize(NamedTuple):
    """The bones of an adult hand."""

    bones: tuple[tuple[int, int], ...]
    """Pairs of the joints of a key-point file."""
    lengths_m: Float[Array, " bone"]


class Hypothesis(NamedTuple):
    """A mistake that people make, and how it is undone."""

    name: str
    cause: str
    """What the user did, as the end of "...: it seems that"."""
    fix: str
    undo: Callable[[Rig, Array], tuple[Rig, Array]]
    """(rig, raw key points) as given -> as they should be."""


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
) -> list[Finding]:
    """Say what is wrong with a rig and its key points; [] = nothing is.

    Args:
        rig: The cameras as read.
        keypoints_px: In pixels of the raw images, NaN = unseen.
        size: What the bones of a hand are like, in the order in which the joints should come.
        joint_orders: Other orders to try: where each joint of the right order stands in the other.

    Returns: Findings of what has to be mended first: one of the camera matrices or pixels (named as in
        `HYPOTHESES`), then `joint order`, then `unit of the rig`; or one `views disagree` or `no hand`,
        where no cause stands out.
    """
    keypoints_px = _few(np.asarray(keypoints_px, np.float64))
    given = _try(None, rig, keypoints_px)
    trial, found = given, []
    if given.agreeing < MIN_AGREEING:
        likely = _likely(given, [_try(h, rig, keypoints_px) for h in HYPOTHESES], size, joint_orders)
        if len(likely) != 1:
            exchanged = [finding for finding in judge_views(rig, keypoints_px) if finding.name in CAUSES]
            return exchanged or [_unexplained(given, likely)]
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


def _try(hypothesis: Hypothesis | None, rig: Rig, keypoints_px: Array) -> _Trial:
    """Triangulate the hands with a mistake undone."""
    if hypothesis is not None:
        rig, keypoints_px = hypothesis.undo(rig, keypoints_px)
    ideal = ideal_keypoints(rig, keypoints_px)
    ideal = ideal.reshape(-1, *ideal.shape[2:])
    # In the first camera's frame and in units of the rig's extent, so that float32 serves any world and unit.
    T_cam_from_primary = rig.T_cam_from_world @ invert_rigid(rig.T_cam_from_world[0])
    centres = invert_rigid(T_cam_from_primary)[:, :3, 3]
    extent = max(float(np.linalg.norm(centres, axis=-1).max()), 1e-12)
    T_cam_from_primary[:, :3, 3] /= extent
    points, valid = _triangulated(ideal, rig.K, T_cam_from_primary)
    uv, depth = project(rig.K, T_cam_from_primary, points[:, None])
    gate = _GATE_SHARE * float(np.linalg.norm(rig.size_wh, axis=-1).mean())
    seen = np.isfinite(ideal).all(-1)
    counted = seen & (seen.sum(1, keepdims=True) >= 2)
    distance = np.linalg.norm(uv - np.nan_to_num(ideal), axis=-1)
    fits = counted & valid[:, None] & (depth > 0) & (distance < gate)
    good = valid & (fits == counted).all(1) & counted.any(1)
    if not counted.any():
        return _Trial(hypothesis, 0.0, np.inf, np.full_like(points, np.nan))
    error = np.median(np.where(valid[:, None] & (depth > 0), distance, np.inf)[counted])
    joints = np.where(good[..., None], extent * points, np.nan)
    return _Trial(hypothesis, float(fits[counted].mean()), float(error), joints)


def _triangulated(uv_px: Array, K: Array, T_cam_from_world: Array) -> tuple[Array, Bool[Array, "hand 21"]]:
    import jax

    from poem_jax.geometry.triangulation import triangulate

    K, T = (np.broadcast_to(x, (len(uv_px), *x.shape)).astype(np.float32) for x in (K, T_cam_from_world))
    points, valid = jax.device_get(jax.jit(triangulate)(uv_px.astype(np.float32), K, T))
    return points.astype(np.float64), valid


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


def _unexplained(given: _Trial, likely: list[_Trial]) -> Finding:
    causes = "; or ".join(trial.hypothesis.cause for trial in likely if trial.hypothesis is not None)
    return Finding(
        "views disagree",
        f"the rig does not fit the key points: only {given.agreeing:.0%} of them fit what the views "
        f"triangulate, and {'it may be that ' + causes if causes else 'no known mistake explains it'}",
        "check that K belongs to the images as they are, that x_cam = R @ x_world + t in OpenCV axes, that "
        "the key points are in pixels of the raw images, and that they are in the rig's order of cameras",
    )


def _no_hand(misfit: float, scale: float) -> Finding:
    return Finding(
        "no hand",
        "the views agree, but the bones are not those of a hand in any known order of its joints: their "
        f"proportions are off by a factor of {np.exp(misfit):.2g}, their size by {scale:.2g}",
        f"check that the joints are in OpenPose's order {_OPENPOSE}, all of one hand, and that the terms "
        "of the lens are right",
    )


def _few(keypoints_px: Array) -> Array:
    """Return the hands, at most `_MAX_HANDS`, as frames of one hand each: those that most views see."""
    hands = keypoints_px.reshape(-1, 1, *keypoints_px.shape[2:])
    count = np.isfinite(hands).all(-1).sum((1, 2, 3))
    best = np.sort(np.argsort(-count, kind="stable")[:_MAX_HANDS])
    # As many as ever, so that one program serves.
    return np.concatenate([hands[best], np.full((_MAX_HANDS - len(best), *hands.shape[1:]), np.nan)])


def _extrinsics(change: Callable[[Array], Array]) -> Callable[[Rig, Array], tuple[Rig, Array]]:
    return lambda rig, uv: (
        rig._replace(T_cam_from_world=change(np.asarray(rig.T_cam_from_world, np.float64))),
        uv,
    )


def _pixels(change: Callable[[Array, Array], Array]) -> Callable[[Rig, Array], tuple[Rig, Array]]:
    """Change key points, as the file counts them, given the sizes (view, 1, 2) of the images."""
    return lambda rig, uv: (rig, change(uv - HALF_PIXEL, rig.size_wh[:, None]) + HALF_PIXEL)


def _then(change: Callable[[Array], Array], signs: tuple[int, int, int]) -> Callable[[Array], Array]:
    """Change extrinsics, then turn the cameras' axes."""
    return lambda T: np.diag([*signs, 1.0]) @ change(T)


def _same(T: Array) -> Array:
    return T


def _centres(T: Array) -> Array:
    """Return the extrinsics whose `t` was given as the cameras' centres."""
    R = T[:, :3, :3]
    return rigid(R, -np.einsum("vij,vj->vi", R, T[:, :3, 3]))


_TO_WORLD = "`R` and `t` map camera points to world points"
_INVERSE = "write the inverses: R^T and -R^T t"
_AXES = {
    "OpenGL or Blender axes (y up, z backward)": (1, -1, -1),
    "axes with x left and y up, as PyTorch3D's": (-1, -1, 1),
    "axes with x left and z backward": (-1, 1, -1),
}
HYPOTHESES: tuple[Hypothesis, ...] = (
    Hypothesis("inverted extrinsics", _TO_WORLD, _INVERSE, _extrinsics(invert_rigid)),
    Hypothesis(
        "centres as t",
        "`t` holds the cameras' centres in the world",
        "write t = -R @ centre",
        _extrinsics(_centres),
    ),
    Hypothesis(
        "transposed R",
        "`R` is transposed, while `t` is right",
        "transpose every `R`",
        _extrinsics(lambda T: rigid(np.swapaxes(T[:, :3, :3], -1, -2), T[:, :3, 3])),
    ),
    Hypothesis(
        "negated t",
        "`t` has the wrong sign",
        "negate every `t`",
        _extrinsics(lambda T: rigid(T[:, :3, :3], -T[:, :3, 3])),
    ),
    *(
        Hypothesis(
            "camera axes",
            f"the cameras have {axes}, not OpenCV's",
            f"multiply `R` and `t` from the left by diag{signs}",
            _extrinsics(_then(_same, signs)),
        )
        for axes, signs in _AXES.items()
    ),
    *(
        Hypothesis(
            "camera axes, inverted extrinsics",
            f"{_TO_WORLD}, and the cameras have {axes}, not OpenCV's",
            f"{_INVERSE}; then multiply both from the left by diag{signs}",
            _extrinsics(_then(invert_rigid, signs)),
        )
        for axes, signs in _AXES.items()
    ),
    *(
        Hypothesis(
            "camera axes, centres as t",
            f"`t` holds the cameras' centres in the world, and the cameras have {axes}, not OpenCV's",
            f"write t = -R @ centre; then multiply both from the left by diag{signs}",
            _extrinsics(_then(_centres, signs)),
        )
        for axes, signs in _AXES.items()
    ),
    Hypothesis(
        "normalised pixels",
        "the key points are shares of the images' width and height, not pixels",
        "multiply x by the width and y by the height",
        _pixels(lambda uv, wh: uv * wh - HALF_PIXEL),
    ),
    Hypothesis(
        "normalised pixels from -1 to 1",
        "the key points run from -1 to 1 over the images, not in pixels",
        "write (x + 1) / 2 times the width, and (y + 1) / 2 times the height",
        _pixels(lambda uv, wh: (uv + 1) / 2 * wh - HALF_PIXEL),
    ),
    Hypothesis(
        "row before column",
        "the key points are given as (y, x)",
        "write x, the column, first",
        _pixels(lambda uv, _: uv[..., ::-1]),
    ),
    Hypothesis(
        "y upwards",
        "y of the key points counts from the images' lower edge",
        "write height - 1 - y",
        _pixels(lambda uv, wh: np.stack([uv[..., 0], wh[..., 1] - 1 - uv[..., 1]], -1)),
    ),
    Hypothesis(
        "mirrored pixels",
        "all images, or their key points, are mirrored left to right",
        "use the images as calibrated; or write width - 1 - x, and exchange left and right",
        _pixels(lambda uv, wh: np.stack([wh[..., 0] - 1 - uv[..., 0], uv[..., 1]], -1)),
    ),
    *(
        Hypothesis(
            "pixels of another resolution",
            f"the key points are of images {1 / factor:.3g} times as large as the rig's",
            f"multiply them by {factor:.3g}, or scale `K`, width and height",
            _pixels(lambda uv, _, factor=factor: (uv + HALF_PIXEL) * factor - HALF_PIXEL),
        )
        for factor in (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 2, 2, 3, 4)
    ),
)
"""The mistakes that are tried. Orders of joints and the unit are judged beside each of them."""
