"""The stage `predict` by a fit: 2D key points in, hands out; it needs no network and no images.

A hand is fitted to `FRAMES_TOGETHER` frames at a time (`poem_jax.fitting.take`). Its shape is one for the
whole take: that of the first frames that show enough of it. What is wrong with the whole take - camera
matrices, unit, side, order of the joints - is said with the first frames that show a hand, before any is
written; a frame in which a hand cannot be fitted is marked, and stops nothing.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.calibration.lens_reach import beyond_the_lens
from poem_jax.calibration.time_words import judge_time
from poem_jax.calibration.view_agreement import judge_views
from poem_jax.capture.agreement import check_each_camera
from poem_jax.capture.fit_trust import joint_confidence
from poem_jax.capture.frame import Frame, HandResult, too_few_views
from poem_jax.capture.frame_padding import FRAMES_TOGETHER, padded_frames, padded_times
from poem_jax.capture.frame_times import SECONDS_PER_FRAME, known_times, times_of
from poem_jax.capture.keypoint_agreement import check_triangulation, judge_fit, shows_palms
from poem_jax.capture.take import Take
from poem_jax.fitting.detector_offsets import offsets_of
from poem_jax.geometry.rig import Rig
from poem_jax.hand.pair import Hands
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.typing import Array

if TYPE_CHECKING:
    from poem_jax.fitting import FitConfig, FitResult
    from poem_jax.fitting.detector_offsets import KeypointOffsets
    from poem_jax.fitting.kinematics import KeypointModel

MIN_VIEWS = 2
"""Fewer do not say where a hand is."""
NOT_FITTED = "fewer than three joints, or only joints on one line, are seen by two views that agree on them"

_CONTEXT = 16
"""Frames before and after that a smoothed frame is held to; what lies farther does not move it."""
_FRAMES_FOR_OFFSETS = 20
"""Fewer do not tell whether the cameras' frames are of one moment; the first group with so many is asked."""
_FRAMES_FOR_SHAPE = 16
"""A hand's shape is settled by the first group that shows it in so many frames."""


def fit_hands(
    frames: Iterable[Frame], take: Take, hands: Hands, *, smooth: bool = False, detector: str | None = None
) -> Iterator[Frame]:
    """Fit the hands of a stream to their key points.

    Args:
        frames: With key points.
        take: Its cameras and the sides of its hands.
        hands: The hand models.
        smooth: Add a second pass that holds each hand's frames together.
        detector: Name of what found the key points (`fitting.detector_offsets`), whose habits the fit then
            takes into account; "none" takes the key points to be the joints; None = as the take names it.

    Returns: the stream with its hands, a warning at the frame where it was noticed.

    Raises:
        ValueError: No key points; fewer than two views; the rig does not fit the first key points, or its
            unit is wrong.
    """
    if take.rig.num_views < 2:
        raise ValueError(f"a fit needs at least two views; the rig has {take.rig.num_views}")
    check_each_camera(take.rig)
    config = fit_config(take.rig, smooth)
    offsets = offsets_of(take.detector if detector is None else detector)
    fits = [
        _HandFit(name, _keypoint_models(hands, side, offsets), config)
        for name, side in zip(take.hand_names, take.hand_sides, strict=True)
    ]
    checked = said = told = timed = False
    for group, turns in _windows(frames, _CONTEXT if smooth else 0):
        raw, confidence = _observed(group)
        keypoints = ideal_keypoints(take.rig, raw)
        time_s = times_of(group) if smooth else np.arange(len(group)) * SECONDS_PER_FRAME
        if not checked and shows_palms(raw):
            check_triangulation(take.rig, raw)
            checked = True
        moments, findings = known_times(group), []
        if not said:
            findings = judge_views(take.rig, raw, time_s=moments)
            seen = np.isfinite(raw).all(-1).any((1, 2, 3)).sum()
            if not findings and not timed and moments is not None and seen >= _FRAMES_FOR_OFFSETS:
                findings, timed = judge_time(take.rig, raw, moments), True
        warnings = [str(finding) for finding in findings]
        said = said or bool(warnings)
        if not told:
            lost = np.isfinite(raw).all(-1) & ~np.isfinite(keypoints).all(-1)
            warnings += beyond_the_lens(take.rig, lost.sum((0, 1, 3)), "key points")
            told = bool(lost.any())
        fitted, trusted = [], []
        for index, hand in enumerate(fits):
            given = keypoints[:, index], confidence[:, index]
            fitted.append(hand.fit(*given, time_s, take.rig))
            trusted.append(joint_confidence(fitted[-1], *given, take.rig))
            warnings += hand.take_warnings()
        for frame in _with_results(group, turns, fitted, trusted):
            yield frame._replace(warnings=(*frame.warnings, *warnings))
            warnings = []


def try_fit(
    frames: Iterable[Frame], take: Take, hands: Hands, detector: str | None = None
) -> Iterator[Frame]:
    """Fit the hands of a few frames as `fit_hands` does, but judge neither the rig nor the sides.

    Each hand has one shape in all of them.
    """
    group = list(frames)
    raw, confidence = _observed(group)
    keypoints = ideal_keypoints(take.rig, raw)
    config = fit_config(take.rig, smooth=False)
    offsets = offsets_of(take.detector if detector is None else detector)
    fitted, trusted = [], []
    evenly = np.arange(len(group)) * SECONDS_PER_FRAME
    for index, side in enumerate(take.hand_sides):
        given, model = (keypoints[:, index], confidence[:, index]), _keypoint_models(hands, side, offsets)[0]
        fitted.append(fit_group(model, *given, evenly, take.rig, config, None))
        trusted.append(joint_confidence(fitted[-1], *given, take.rig))
    yield from _with_results(group, range(len(group)), fitted, trusted)


def _with_results(
    group: list[Frame], turns: range, fitted: list["FitResult"], trusted: list[Array]
) -> Iterator[Frame]:
    """Give the frames whose turn it is what came of their hands."""
    seen = np.isfinite(_observed(group)[0]).all(-1).any(-1).sum(-1)
    for turn in turns:
        pairs = zip(fitted, trusted, strict=True)
        found = [fitted_hand(fit, turn, trust) for fit, trust in pairs]
        yield group[turn]._replace(hands=tuple(map(_with_reason, found, seen[turn].tolist())))


def _keypoint_models(
    hands: Hands, side: str, offsets: "KeypointOffsets | None"
) -> tuple["KeypointModel", "KeypointModel"]:
    """Return what a fit needs of the hand of a side, and of its mirror image."""
    from poem_jax.fitting import keypoint_model

    return keypoint_model(hands.of(side), offsets), keypoint_model(hands.other(side), offsets)


def fit_config(rig: Rig, smooth: bool) -> "FitConfig":
    """Return the settings of a fit for images of the rig's size, with the second pass or without."""
    from poem_jax.fitting import FitConfig, KeypointNoise
    from poem_jax.fitting.smooth import SmoothConfig

    return FitConfig(noise=KeypointNoise.of_images(rig.size_wh), smooth=SmoothConfig() if smooth else None)


def _windows(frames: Iterable[Frame], context: int) -> Iterator[tuple[list[Frame], range]]:
    """Cut a stream into lists of `FRAMES_TOGETHER` that share `context` frames on either side.

    Yields: a list, and the places in it whose turn it is; each frame has its turn once, in order.
    """
    window: list[Frame] = []
    done = 0
    for frame in frames:
        window.append(frame)
        if len(window) == FRAMES_TOGETHER:
            yield window, range(done, FRAMES_TOGETHER - context)
            window, done = window[FRAMES_TOGETHER - 2 * context :], context
    if done < len(window):
        yield window, range(done, len(window))


def _observed(group: list[Frame]) -> tuple[Array, Array]:
    """Return the key points of a group as given (frame, hand, view, 21, 2), and their confidence."""
    given = [frame.keypoints_px for frame in group if frame.keypoints_px is not None]
    if len(given) < len(group):
        raise ValueError(
            "a fit needs 2D key points; this capture has boxes only: give `keypoints_px`, or use the network"
        )
    keypoints = np.stack(given)
    even = np.ones(keypoints.shape[1:-1])
    return keypoints, np.stack([even if f.confidence is None else f.confidence for f in group])


class _HandFit:
    """One hand through the take, and as a check one of the other side."""

    def __init__(
        self, name: str, models: tuple["KeypointModel", "KeypointModel"], config: "FitConfig"
    ) -> None:
        self._name, self._models, self._config = name, models, config
        self._shapes: tuple[Array | None, Array | None] = (None, None)
        self._judged = self._said = False
        self._warnings: list[str] = []

    def fit(self, keypoints: Array, confidence: Array, time_s: Array, rig: Rig) -> "FitResult":
        """Fit a group of frames: key points (frame, view, 21, 2), their confidence, and their times."""
        own, other = (
            fit_group(model, keypoints, confidence, time_s, rig, self._config, shape)
            for model, shape in zip(self._models, self._shapes, strict=True)
        )
        enough = own.valid.sum() >= _FRAMES_FOR_SHAPE
        if own.valid.any() and not self._said and (enough or not self._judged):
            self._warnings = judge_fit(self._name, own, other, self._config.noise)
            self._judged, self._said = True, bool(self._warnings)
        if enough and self._shapes[0] is None:
            self._shapes = own.shape[0], other.shape[0]
        return own

    def take_warnings(self) -> list[str]:
        """Return what the last group gave cause to say, once."""
        warnings, self._warnings = self._warnings, []
        return warnings


def fit_group(
    model: "KeypointModel",
    keypoints: Array,
    confidence: Array,
    time_s: Array,
    rig: Rig,
    config: "FitConfig",
    shape: Array | None,
    together: int = FRAMES_TOGETHER,
) -> "FitResult":
    """Fit a hand to a group of frames, padded to a size for which there is a program.

    Args:
        model: The hand.
        keypoints: (frame, view, 21, 2), pixels without distortion; NaN = unseen.
        confidence: Of the key points (frame, view, 21).
        time_s: When the frames were taken.
        rig: The cameras.
        config: Of the fit.
        shape: Of the hand (10,); None = unknown, one for all frames.
        together: The group is padded to a multiple of it.
    """
    import jax

    from poem_jax.fitting import Observations, fit_take
    from poem_jax.fitting.lm import ShapeMode

    if shape is not None:
        lm = dataclasses.replace(config.lm, shape_mode=ShapeMode.GIVEN)
        config = dataclasses.replace(config, lm=lm)
    padded = (padded_frames(keypoints, together), padded_frames(confidence, together))
    observations = Observations(*padded, rig.K, rig.T_cam_from_world)
    fitted = jax.device_get(fit_take(model, observations, shape, config, padded_times(time_s, together)))
    return jax.tree.map(lambda array: array[: len(keypoints)], fitted)


def _with_reason(found: HandResult, views: int) -> HandResult:
    """Say of a hand that no two views see that this is why it was not fitted."""
    few = found.reason is not None and views < MIN_VIEWS
    return found._replace(reason=too_few_views(views, MIN_VIEWS)) if few else found


def fitted_hand(fitted: "FitResult", turn: int, trusted: Array) -> HandResult:
    """Return what a fit says of the hand in frame number `turn`, or why it says nothing.

    Args:
        fitted: The hand over some frames.
        turn: The frame.
        trusted: `fit_trust.joint_confidence` of the fit.
    """
    used = fitted.inlier_mask[turn].any(-1)
    if not fitted.valid[turn]:
        return HandResult(used, NOT_FITTED)
    return HandResult(
        used,
        vertices_world=fitted.vertices[turn],
        joints_world=fitted.joints[turn],
        root_world=fitted.joints[turn, ROOT_JOINT],
        pose=fitted.pose[turn],
        shape=fitted.shape[turn],
        translation=fitted.translation[turn],
        expected_world=fitted.keypoints[turn],
        joint_sigma_m=fitted.sigma_m[turn],
        joint_confidence=trusted[turn],
        alone_world=fitted.alone[turn],
    )
