"""From 2D key points and a rig to hand meshes: the whole of `poem fit`, which needs no network and no images.

Every hand is fitted to all of its frames at once (`poem_jax.fitting.take`), so that its shape is one. What
is wrong with the whole take - camera matrices, unit, side, order of the joints - is said once, before
anything is written; a frame in which a hand cannot be fitted is marked, and stops nothing.
"""

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from tqdm import tqdm

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.calibration.view_agreement import judge_views
from poem_jax.capture.agreement import check_each_camera
from poem_jax.capture.boxes_file import align_boxes, frame_key, read_boxes, without_boxes_outside
from poem_jax.capture.folder import FramePaths, find_frames
from poem_jax.capture.frame_padding import padded_frames
from poem_jax.capture.keypoint_agreement import check_triangulation, judge_fit
from poem_jax.capture.reprojection import given_evidence, joints_shown, reprojection_error
from poem_jax.capture.results import Clock, FrameResults, Written, results_folder, write_results
from poem_jax.capture.rig_file import find_rig
from poem_jax.capture.samples import HandResult
from poem_jax.capture.take import FrameOutcome, HandOutcome, Take, read_frame
from poem_jax.geometry.rig import Rig
from poem_jax.hand.model import HandModel, mirror
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.typing import Array

if TYPE_CHECKING:
    from poem_jax.fitting import FitConfig, FitResult

NOT_FITTED = "fewer than three joints, or only joints on one line, are seen by two views that agree on them"

_log = logging.getLogger(__name__)


class Hands(NamedTuple):
    """The hand models of both sides."""

    right: HandModel
    left: HandModel

    def of(self, side: str) -> HandModel:
        """Return the model of a side."""
        return self.left if side == "left" else self.right

    def other(self, side: str) -> HandModel:
        """Return the model of the opposite side."""
        return self.right if side == "left" else self.left


def hands_of(model: HandModel) -> Hands:
    """Return a hand and its mirror image."""
    reflected = HandModel(*(np.asarray(array) for array in mirror(model)))
    return Hands(reflected, model) if model.side == "left" else Hands(model, reflected)


def read_keypoint_take(
    keypoints: str | os.PathLike,
    rig: str | os.PathLike | None = None,
    images: str | os.PathLike | None = None,
) -> Take:
    """Read key points and rig; the frames are those of the key-point file.

    Args:
        keypoints: File of key points.
        rig: Rig file; None = `rig.json` or `calibration/rig.json` in the folder `images` where that is given,
            else beside the key points.
        images: Capture folder to draw on; its frames are found by name. None = no images.

    Raises:
        FileNotFoundError: A file, or every image, is missing.
        ValueError: One of them is wrong, they have different numbers of views, or no name of a frame fits.
    """
    found = find_rig(Path(keypoints).parent if images is None else images, rig)
    hands = read_boxes(keypoints)
    if hands.keypoints_px is None:
        raise ValueError(
            f"{keypoints} holds boxes only; a fit needs `keypoints_px (F, H, V, 21, 2)`, OpenPose order"
        )
    pictures = [] if images is None else find_frames(images, found.names)
    by_key = {frame_key(frame.name): frame for frame in pictures}
    names = hands.frames or _frame_names(len(hands.boxes_px), pictures)
    hands = align_boxes(hands, names, found.names, keypoints)
    nothing = (None,) * found.num_views
    frames = [by_key.get(frame_key(name), FramePaths(name, nothing)) for name in names]
    if len(pictures) == len(names) == 1:
        frames = pictures
    if pictures and not any(frame in pictures for frame in frames):
        raise ValueError(
            f"{images}: no frame of it ({', '.join(frame.name for frame in pictures[:3])}) is among those of "
            f"{keypoints} ({', '.join(names[:3])})"
        )
    return Take(found, frames, without_boxes_outside(hands, found.size_wh))


def fit(
    take: Take,
    out: str | os.PathLike,
    *,
    hand: HandModel | None = None,
    smooth: bool = False,
    progress: bool = True,
) -> Written:
    """Fit every hand of a take to its key points, and write what `reconstruct` writes, under `out`.

    Beyond that `prediction.npz` holds `joint_sigma_m (F,H,21)`, the standard deviation of one coordinate of
    every joint, and `pose`, `shape` and `translation` of the hand model.

    Args:
        take: From `read_keypoint_take`, or from `read_take` where the boxes come with key points.
        out: Folder for the results.
        hand: The user's hand in MANO's schema, of either side; None = the shipped hand.
        smooth: Add a second pass that holds each hand's frames together.
        progress: Show a progress bar when there are several frames.

    Raises:
        FileNotFoundError, ValueError: No key points; fewer than two views; the rig does not fit the key
            points, or its unit is wrong; no hand can be fitted; `out` is a file.
    """
    from poem_jax.hand.template import default_hand

    clock = Clock()
    out = results_folder(out)
    _check_take(take)
    hands = hands_of(default_hand() if hand is None else hand)
    keypoints = ideal_keypoints(take.rig, take.hands.keypoints_px)
    check_triangulation(take.rig, keypoints)
    warnings = [str(finding) for finding in judge_views(take.rig, take.hands.keypoints_px)]
    clock.lap("triangulate_with_compilation")
    config = fit_config(take.rig, smooth)
    results = []
    for index in range(len(take.hand_names)):
        fitted, said = _fit_hand(take, keypoints, hands, index, config)
        results.append(fitted)
        warnings += said
    for warning in warnings:
        _log.warning("%s", warning)
    clock.lap("fit_with_compilation")
    frames = _stream(take, results, progress)
    faces = {"right": hands.right.faces, "left": hands.left.faces}
    kind = "shipped hand" if hand is None else "given"
    about = {"engine": "fit", "hand": kind, "smooth": smooth, "warnings": warnings}
    return write_results(take, out, frames, faces, clock, about)


def fit_config(rig: Rig, smooth: bool) -> "FitConfig":
    """Return the settings of a fit for images of the rig's size, with the second pass or without."""
    from poem_jax.fitting import FitConfig, KeypointNoise
    from poem_jax.fitting.smooth import SmoothConfig

    return FitConfig(noise=KeypointNoise.of_images(rig.size_wh), smooth=SmoothConfig() if smooth else None)


def _check_take(take: Take) -> None:
    if take.hands.keypoints_px is None:
        raise ValueError(
            "a fit needs 2D key points; this capture has boxes only: give `keypoints_px`, or use the network"
        )
    if take.rig.num_views < 2:
        raise ValueError(f"a fit needs at least two views; the rig has {take.rig.num_views}")
    check_each_camera(take.rig)


def _fit_hand(
    take: Take, keypoints: Array, hands: Hands, index: int, config: "FitConfig"
) -> tuple["FitResult", list[str]]:
    """Fit one hand, and as a check one of the other side; return the first, and what is to be said."""
    side = take.hands.hand_side[index]
    confidence = take.hands.confidence
    confidence = np.ones(keypoints[:, index].shape[:-1]) if confidence is None else confidence[:, index]
    evidence = (keypoints[:, index], confidence, take.rig, config)
    own = _run(hands.of(side), *evidence)
    other = _run(hands.other(side), *evidence)
    return own, judge_fit(take.hand_names[index], own, other, config.noise)


def _run(hand: HandModel, keypoints: Array, confidence: Array, rig: Rig, config: "FitConfig") -> "FitResult":
    import jax

    from poem_jax.fitting import Observations, fit_take, keypoint_model

    frames = len(keypoints)
    padded = (padded_frames(keypoints), padded_frames(confidence))
    observations = Observations(*padded, rig.K, rig.T_cam_from_world)
    fitted = jax.device_get(fit_take(keypoint_model(hand), observations, config=config))
    return jax.tree.map(lambda array: array[:frames], fitted)


def _stream(take: Take, results: list["FitResult"], progress: bool) -> Iterator[FrameResults]:
    several = len(take.frames) > 1
    for frame in tqdm(range(len(take.frames)), unit="frame", disable=not (progress and several)):
        found = read_frame(take, frame, images_needed=False)
        for problem in found.problems:
            _log.warning("frame %s: an image is left out: %s", take.frames[frame].name, problem.error)
        outcomes = tuple(_outcome(take, frame, index, result) for index, result in enumerate(results))
        yield FrameResults(found.images, FrameOutcome(outcomes, found.problems))


def _outcome(take: Take, frame: int, index: int, fitted: "FitResult") -> HandOutcome:
    used = fitted.inlier_mask[frame].any(-1)
    if not fitted.valid[frame]:
        nothing = np.full(take.rig.num_views, np.nan)
        name = take.frames[frame].name
        _log.warning("frame %s: hand '%s' is left out: %s", name, take.hand_names[index], NOT_FITTED)
        return HandOutcome(None, used, nothing, nothing, NOT_FITTED)
    joints = fitted.joints[frame]
    result = HandResult(
        valid=True,
        vertices_world=fitted.vertices[frame],
        joints_world=joints,
        root_world=joints[ROOT_JOINT],
        pose=fitted.pose[frame],
        shape=fitted.shape[frame],
        translation=fitted.translation[frame],
        joint_sigma_m=fitted.sigma_m[frame],
    )
    evidence = given_evidence(take.hands, frame, index)
    seen = np.isfinite(evidence.points_px).all(-1).any(-1)
    errors = reprojection_error(joints, evidence, seen, take.rig)
    return HandOutcome(result, used, errors, joints_shown(joints, used, take.rig))


def _frame_names(count: int, pictures: list[FramePaths]) -> tuple[str, ...]:
    """Name frames that the file does not: as those of the images where these are as many, else by number."""
    if len(pictures) == count:
        return tuple(frame.name for frame in pictures)
    return tuple(f"{index:04d}" for index in range(count))
