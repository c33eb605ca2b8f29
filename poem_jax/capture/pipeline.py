"""From a folder of calibrated images to hand meshes: the whole of `poem reconstruct`.

Frames stream through in groups that fill one batch of the model, so that memory does not grow with the take
and one program serves all of it. The rig is judged once, before any image is read, and refused if it is
wrong. An image that cannot be read, or a hand whose boxes do not fit together, does not stop a take: the
report says why.
"""

import functools
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from poem_jax.capture.agreement import Reasons, judge_take
from poem_jax.capture.boxes_file import HOW_TO_GET_BOXES, align_frames, read_boxes, without_boxes_outside
from poem_jax.capture.engine import Engine, load_engine, reconstruct_samples
from poem_jax.capture.folder import find_frames
from poem_jax.capture.outcome import hand_outcome
from poem_jax.capture.outputs import (
    PageFrames,
    frame_report,
    make_gallery,
    page_frame,
    remove_stale_meshes,
    versions,
    write_arrays,
    write_frame,
    write_json,
)
from poem_jax.capture.reprojection import error_summary
from poem_jax.capture.rig_file import read_rig
from poem_jax.capture.samples import HandResult, HandSample, empty_sample, make_sample
from poem_jax.capture.take import FrameImages, FrameOutcome, Take, prediction_arrays, read_frame
from poem_jax.typing import Array, UInt8
from poem_jax.viz.page import HOW_TO_GET_THE_PAGE, PageCamera, PageFrame, page_available, write_page

RIG_FILES = ("rig.json", "calibration/rig.json")
BOXES_FILES = ("boxes.npz",)
MAX_BATCH = 4
"""Hands at a time: enough to keep two cores busy, little enough to wait for."""

_log = logging.getLogger(__name__)


class Written(NamedTuple):
    """What a reconstruction gave."""

    arrays: dict[str, Array]
    """As in `prediction.npz`."""
    report: dict[str, Any]
    """As in `report.json`."""
    files: list[Path]
    """Everything that was written."""


class _Clock:
    """Seconds spent per activity."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = self._start = time.perf_counter()

    def lap(self, activity: str) -> None:
        """Book the time since the last lap."""
        now = time.perf_counter()
        self.seconds[activity] = self.seconds.get(activity, 0.0) + now - self._last
        self._last = now

    def rounded(self) -> dict[str, float]:
        """Return everything booked, and the total."""
        total = time.perf_counter() - self._start
        return {name: round(value, 3) for name, value in {**self.seconds, "total": total}.items()}


def read_take(
    folder: str | os.PathLike, rig: str | os.PathLike | None = None, boxes: str | os.PathLike | None = None
) -> Take:
    """Read rig and boxes of a capture, and list its frames.

    Args:
        folder: One image per camera, or `frames/<frame>/<camera>.jpg`.
        rig: Rig file; None = `rig.json` or `calibration/rig.json` in the folder.
        boxes: File of boxes or key points; None = `boxes.npz` in the folder.

    Raises:
        FileNotFoundError: Folder, rig, boxes or images are missing.
        ValueError: One of them is wrong.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no capture folder at {folder}")
    found = read_rig(_given_or_found(rig, folder, RIG_FILES, "no rig: pass --rig FILE, or put it there"))
    frames = find_frames(folder, found.names)
    boxes_file = _given_or_found(boxes, folder, BOXES_FILES, HOW_TO_GET_BOXES)
    names = tuple(frame.name for frame in frames)
    hands = align_frames(read_boxes(boxes_file), names, found.num_views, boxes_file)
    return Take(found, frames, without_boxes_outside(hands, found.size_wh))


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
    clock = _Clock()
    out = Path(out)
    _check_out(out)
    engine = load_engine(checkpoint, batch_size(take)) if engine is None else engine
    clock.lap("load_model")
    faces = faces_by_side(engine)
    reasons = judge_take(take, engine.config.image_hw)
    gallery = make_gallery(take.rig, len(take.frames))
    outcomes: list[FrameOutcome] = []
    page_frames = PageFrames()
    files: list[Path] = []
    for frame, images, outcome in _stream(take, engine, reasons, clock, progress):
        name = take.frames[frame].name
        outcomes.append(outcome)
        files += write_frame(out / name, take, outcome, images, faces)
        if outcome.solved:
            page_frames.offer(functools.partial(page_frame, take, outcome, name, images, gallery))
        clock.lap("write")
    _check_any(take, outcomes)
    arrays = prediction_arrays(take, outcomes)
    files.append(write_arrays(out / "prediction.npz", arrays))
    files += _write_page(out / "index.html", page_frames.kept, gallery.cameras, faces)
    clock.lap("write")
    report = _report(take, outcomes, arrays, engine, clock)
    files.append(write_json(out / "report.json", report))
    remove_stale_meshes(out, take, outcomes)
    return Written(arrays, report, files)


def batch_size(take: Take) -> int:
    """Return how many hands the model takes at a time: whole frames, at most `MAX_BATCH` where one fits."""
    num_hands = len(take.hands.hand_side)
    return num_hands * min(len(take.frames), max(1, MAX_BATCH // num_hands))


def faces_by_side(engine: Engine) -> dict[str, Array]:
    """Return the triangles of the model's hand, and those of its mirror image, facing outwards."""
    right = np.asarray(engine.model.params["constants"]["hand"]["faces"])
    return {"right": right, "left": np.ascontiguousarray(right[:, ::-1])}


def _check_out(out: Path) -> None:
    """Raise if a file stands where the folder for the results, or one above it, should be."""
    existing = next((path for path in (out, *out.parents) if path.exists()), out)
    if existing.is_file():
        raise ValueError(f"the results go to a folder; {existing} is a file: give another --out")


def _stream(
    take: Take, engine: Engine, reasons: Reasons, clock: _Clock, progress: bool
) -> Iterator[tuple[int, list[UInt8[Array, "h w 3"] | None], FrameOutcome]]:
    """Yield every frame's index, images and outcome, in order, a batch of the model at a time."""
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
                yield frame, found.images, FrameOutcome(hands, found.problems)
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


def _check_any(take: Take, outcomes: list[FrameOutcome]) -> None:
    """Raise if nothing at all came of a take: the first lost image, or why no hand was solved."""
    if any(outcome.solved for outcome in outcomes):
        return
    lost = (problem.error for outcome in outcomes for problem in outcome.problems if problem.needed)
    if (error := next(lost, None)) is not None:
        raise error
    views = int(np.isfinite(take.hands.boxes_px).all(-1).sum(-1).max(initial=0))
    if views < 2:
        raise ValueError(
            f"no hand could be reconstructed: at least two views must see it; at most {views} of "
            f"{take.rig.num_views} do. Add boxes for more views"
        )
    hands = [hand for outcome in outcomes for hand in outcome.hands]
    best = max(hands, key=lambda hand: int(hand.view_mask.sum()))
    raise ValueError(f"no hand could be reconstructed: {best.reason}")


def _write_page(
    path: Path, frames: list[PageFrame], cameras: list[PageCamera], faces: dict[str, Array]
) -> list[Path]:
    """Write the page if that can be done here; a warning says why not. The other results do not need it."""
    if not page_available():
        _log.warning(HOW_TO_GET_THE_PAGE)
        return []
    try:
        return [write_page(path, frames, cameras, faces)]
    except OSError as error:  # It takes a free port to record a page.
        _log.warning("the 3D page cannot be written, everything else is: %s", error)
        return []


def _report(
    take: Take, outcomes: list[FrameOutcome], arrays: dict[str, Array], engine: Engine, clock: _Clock
) -> dict[str, Any]:
    return {
        "timings_s": clock.rounded(),
        "reprojection": error_summary(arrays["reprojection_px"], arrays["views_used"], take.hands),
        "weights": engine.origin,
        "image_hw": list(engine.config.image_hw),
        "cameras": list(take.rig.names),
        "hands": list(take.hand_names),
        "failed_frames": sum(bool(outcome.problems) and not outcome.solved for outcome in outcomes),
        "frames": [frame_report(take, frame, outcome) for frame, outcome in enumerate(outcomes)],
        "versions": versions(),
    }


def _given_or_found(
    given: str | os.PathLike | None, folder: Path, candidates: tuple[str, ...], help_text: str
) -> Path:
    if given is not None:
        return Path(given)
    found = next((folder / name for name in candidates if (folder / name).is_file()), None)
    if found is None:
        looked = " or ".join(str(folder / name) for name in candidates)
        raise FileNotFoundError(f"no {looked}: {help_text}")
    return found
