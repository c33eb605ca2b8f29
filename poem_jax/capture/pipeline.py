"""From a folder of calibrated images to hand meshes: the whole of `poem reconstruct`.

Frames stream through in groups that fill one batch of the model, so that memory does not grow with the take
and one program serves all of it. The rig is judged once, before any image is read, and refused if it is
wrong. An image that cannot be read, or a hand whose boxes do not fit together, does not stop a take: the
report says why.
"""

import logging
import os
from collections.abc import Iterator

import numpy as np
from tqdm import tqdm

from poem_jax.capture.agreement import Reasons, judge_take
from poem_jax.capture.engine import Engine, load_engine, reconstruct_samples
from poem_jax.capture.outcome import hand_outcome
from poem_jax.capture.results import Clock, FrameResults, Written, results_folder, write_results
from poem_jax.capture.samples import HandResult, HandSample, empty_sample, make_sample
from poem_jax.capture.take import FrameImages, FrameOutcome, Take, read_frame
from poem_jax.typing import Array

MAX_BATCH = 4
"""Hands at a time: enough to keep two cores busy, little enough to wait for."""

_log = logging.getLogger(__name__)


def reconstruct(
    take: Take,
    out: str | os.PathLike,
    *,
    checkpoint: str | os.PathLike | None = None,
    engine: Engine | None = None,
    progress: bool = True,
) -> Written:
    """Reconstruct every hand of every frame, and write meshes, overlays, arrays, report and page under `out`.

    Args:
        take: From `read_take`.
        out: Folder for the results, `out/<frame>/...`; made when missing, files of the same name replaced.
        checkpoint: Model folder; None = the shipped weights. Not read when an engine is given.
        engine: A model in memory.
        progress: Show a progress bar when there are several frames.

    Raises:
        FileNotFoundError, ValueError: The checkpoint, the rig, an image of the only frame, or all frames
            cannot be used; no hand is seen by two views; `out` is a file.
    """
    clock = Clock()
    out = results_folder(out)
    engine = load_engine(checkpoint, batch_size(take)) if engine is None else engine
    clock.lap("load_model")
    reasons = judge_take(take, engine.config.image_hw)
    frames = _stream(take, engine, reasons, clock, progress)
    about = {"engine": "network", "weights": engine.origin, "image_hw": list(engine.config.image_hw)}
    return write_results(take, out, frames, faces_by_side(engine), clock, about)


def batch_size(take: Take) -> int:
    """Return how many hands the model takes at a time: whole frames, at most `MAX_BATCH` where one fits."""
    num_hands = len(take.hands.hand_side)
    return num_hands * min(len(take.frames), max(1, MAX_BATCH // num_hands))


def faces_by_side(engine: Engine) -> dict[str, Array]:
    """Return the triangles of the model's hand, and those of its mirror image, facing outwards."""
    right = np.asarray(engine.model.params["constants"]["hand"]["faces"])
    return {"right": right, "left": np.ascontiguousarray(right[:, ::-1])}


def _stream(
    take: Take, engine: Engine, reasons: Reasons, clock: Clock, progress: bool
) -> Iterator[FrameResults]:
    """Yield every frame's images and outcome, in order, a batch of the model at a time."""
    group = max(1, engine.batch_size // len(take.hands.hand_side))
    several = len(take.frames) > 1
    with tqdm(total=len(take.frames), unit="frame", disable=not (progress and several)) as bar:
        for start in range(0, len(take.frames), group):
            frames = range(start, min(start + group, len(take.frames)))
            loaded = [_load(take, frame, reasons[frame], engine.config.image_hw, several) for frame in frames]
            clock.lap("read_and_crop")
            samples = [sample for _, samples in loaded for sample in samples]
            results = iter(_run(engine, samples))
            clock.lap("first_batch_with_compilation" if start == 0 else "later_batches")
            for frame, (found, samples) in zip(frames, loaded, strict=True):
                hands = tuple(
                    hand_outcome(take, frame, hand, sample, next(results), reasons[frame][hand])
                    for hand, sample in enumerate(samples)
                )
                _warn(take, frame, found, reasons[frame])
                yield FrameResults(found.images, FrameOutcome(hands, found.problems))
                bar.update()


def _load(
    take: Take, frame: int, reasons: tuple[str | None, ...], image_hw: tuple[int, int], go_on: bool
) -> tuple[FrameImages, list[HandSample]]:
    """Read a frame and crop its hands; hands with a reason against them, and lost images, are masked.

    Raises:
        FileNotFoundError, ValueError: An image with a box in it is lost, and this frame is the only one.
    """
    found = read_frame(take, frame)
    needed = next((problem.error for problem in found.problems if problem.needed), None)
    if needed is not None and not go_on:
        raise needed
    samples = [
        empty_sample(take.rig.num_views, image_hw)
        if reason is not None
        else make_sample(found.images, take.rig, take.hands, frame, hand, image_hw)
        for hand, reason in enumerate(reasons)
    ]
    return found, samples


def _warn(take: Take, frame: int, found: FrameImages, reasons: tuple[str | None, ...]) -> None:
    """Say what of a frame is left out."""
    name = take.frames[frame].name
    for problem in found.problems:
        _log.warning("frame %s: an image is left out: %s", name, problem.error)
    for hand, reason in zip(take.hand_names, reasons, strict=True):
        if reason is not None:
            _log.warning("frame %s: hand '%s' is left out: %s", name, hand, reason)


def _run(engine: Engine, samples: list[HandSample]) -> list[HandResult]:
    starts = range(0, len(samples), engine.batch_size)
    chunks = (samples[start : start + engine.batch_size] for start in starts)
    return [result for chunk in chunks for result in reconstruct_samples(engine, chunk)]
