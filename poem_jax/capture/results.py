"""From hands to files: what every engine leaves under the folder of results, written frame by frame."""

import functools
import logging
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

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
from poem_jax.capture.take import FrameOutcome, Take, prediction_arrays
from poem_jax.typing import Array, UInt8
from poem_jax.viz.page import HOW_TO_GET_THE_PAGE, PageCamera, PageFrame, page_available, write_page

_log = logging.getLogger(__name__)


class Written(NamedTuple):
    """What a reconstruction gave."""

    arrays: dict[str, Array]
    """As in `prediction.npz`."""
    report: dict[str, Any]
    """As in `report.json`."""
    files: list[Path]
    """Everything that was written."""


class Clock:
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


class FrameResults(NamedTuple):
    """One frame, done."""

    images: list[UInt8[Array, "h w 3"] | None]
    """One per camera of the rig."""
    outcome: FrameOutcome


def write_results(
    take: Take,
    out: Path,
    frames: Iterable[FrameResults],
    faces: Mapping[str, Array],
    clock: Clock,
    about: Mapping[str, Any],
) -> Written:
    """Write meshes, overlays, arrays, page and report under `out`, `out/<frame>/...`, as the frames come.

    Args:
        take: The capture.
        out: Folder for the results, from `results_folder`.
        frames: All frames of the take, in order.
        faces: Triangles of the hands by side.
        clock: Books the time for writing.
        about: What the report says of the engine.

    Raises:
        FileNotFoundError, ValueError: No hand came out of the whole take; why.
    """
    gallery = make_gallery(take.rig, len(take.frames))
    outcomes: list[FrameOutcome] = []
    page_frames = PageFrames()
    files: list[Path] = []
    for frame, (images, outcome) in zip(take.frames, frames, strict=True):
        outcomes.append(outcome)
        files += write_frame(out / frame.name, take, outcome, images, faces)
        if outcome.solved:
            page_frames.offer(functools.partial(page_frame, take, outcome, frame.name, images, gallery))
        clock.lap("write")
    _check_any(take, outcomes)
    arrays = prediction_arrays(take, outcomes)
    files.append(write_arrays(out / "prediction.npz", arrays))
    files += _write_page(out / "index.html", page_frames.kept, gallery.cameras, faces)
    clock.lap("write")
    report = _report(take, outcomes, arrays, clock, about)
    files.append(write_json(out / "report.json", report))
    remove_stale_meshes(out, take, outcomes)
    return Written(arrays, report, files)


def results_folder(out: str | os.PathLike) -> Path:
    """Return the path of a folder for results; it need not exist.

    Raises: ValueError: A file stands there, or where a folder above it should be.
    """
    out = Path(out)
    existing = next((path for path in (out, *out.parents) if path.exists()), out)
    if existing.is_file():
        raise ValueError(f"the results go to a folder; {existing} is a file: give another --out")
    return out


def _check_any(take: Take, outcomes: list[FrameOutcome]) -> None:
    """Raise if nothing at all came of a take: the first lost image, or why no hand was solved."""
    if any(outcome.solved for outcome in outcomes):
        return
    lost = (problem.error for outcome in outcomes for problem in outcome.problems if problem.needed)
    if (error := next(lost, None)) is not None:
        raise error
    seen = np.isfinite(take.hands.boxes_px).all(-1)
    if take.hands.keypoints_px is not None:
        seen |= np.isfinite(take.hands.keypoints_px).all(-1).any(-1)
    views = int(seen.sum(-1).max(initial=0))
    if views < 2:
        raise ValueError(
            f"no hand could be reconstructed: at least two views must see it; at most {views} of "
            f"{take.rig.num_views} do. Add boxes for more views"
        )
    hands = [hand for outcome in outcomes for hand in outcome.hands]
    best = max(hands, key=lambda hand: int(hand.view_mask.sum()))
    raise ValueError(f"no hand could be reconstructed: {best.reason}")


def _write_page(
    path: Path, frames: list[PageFrame], cameras: list[PageCamera], faces: Mapping[str, Array]
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
    take: Take,
    outcomes: list[FrameOutcome],
    arrays: dict[str, Array],
    clock: Clock,
    about: Mapping[str, Any],
) -> dict[str, Any]:
    return {
        "timings_s": clock.rounded(),
        "reprojection": error_summary(arrays["reprojection_px"], arrays["views_used"], take.hands),
        **about,
        "cameras": list(take.rig.names),
        "hands": list(take.hand_names),
        "failed_frames": sum(outcome.failed for outcome in outcomes),
        "frames": [frame_report(take, frame, outcome) for frame, outcome in enumerate(outcomes)],
        "versions": versions(),
    }
