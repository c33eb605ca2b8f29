"""`report.json`: what came of each frame, what is to be known of the whole take, and how long it took."""

import json
import os
import platform
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.take import Take
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float

_NOTHING = "nothing, for the model has no heat maps"


class Clock:
    """Seconds spent per activity; those inside of others count for themselves alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = self._start = time.perf_counter()
        self._running = ["write"]

    def timed(self, activity: str, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Pass a stream on, and book the time that it takes to make each frame."""
        iterator = iter(frames)
        while True:
            self._book()
            self._running.append(activity)
            try:
                frame = next(iterator)
            except StopIteration:
                return
            finally:
                self._book()
                self._running.pop()
            yield frame

    def lap(self, activity: str) -> None:
        """Book the time since anything was last booked."""
        self._running.append(activity)
        self._book()
        self._running.pop()

    def rounded(self) -> dict[str, float]:
        """Return everything booked, and the total."""
        self._book()
        total = time.perf_counter() - self._start
        return {name: round(value, 3) for name, value in {**self.seconds, "total": total}.items()}

    def _book(self) -> None:
        now = time.perf_counter()
        activity = self._running[-1]
        self.seconds[activity] = self.seconds.get(activity, 0.0) + now - self._last
        self._last = now


class Report:
    """The report of a take; its frames are gathered in an unnamed file, so that memory does not grow."""

    def __init__(self, path: Path, take: Take) -> None:
        self.path = path
        self.frames = self.hands = self.solved = self.failed_frames = 0
        self.warnings: list[str] = []
        self._take = take
        self._errors: list[Array] = []
        self._times: list[float] = []
        self._bridged = [0] * len(take.hand_sides)
        self._sigmas_mm: list[float] = []
        self._views_used = 0
        self._against = "the key points given"
        self._problem: FileNotFoundError | ValueError | None = None
        self._best: HandResult | None = None
        self._seen_by = 0
        self._entries = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115

    def add(self, frame: Frame) -> list[str]:
        """Take a frame in; return its warnings that were not given before."""
        entry = json.dumps(_plain(_entry(frame, self._take)), allow_nan=False)
        self._entries.write(f"{',' if self.frames else ''}\n {entry}")
        self.frames += 1
        self.hands += len(frame.hands)
        solved = [hand for hand in frame.hands if hand.reason is None]
        self.solved += len(solved)
        self.failed_frames += not solved and (
            bool(frame.problems) or any(hand.view_mask.any() for hand in frame.hands)
        )
        if frame.keypoints_px is None and self._against != _NOTHING:
            no_maps = bool(solved) and all(
                np.isnan(np.asarray(hand.reprojection_px, float)).all() for hand in solved
            )
            self._against = _NOTHING if no_maps else "the model's own heat maps"
        self._errors += [np.asarray(hand.reprojection_px, np.float32) for hand in solved]
        self._views_used += sum(int(hand.view_mask.sum()) for hand in frame.hands)
        self._times.append(np.nan if frame.time_s is None else frame.time_s)
        self._bridged = [n + hand.bridged for n, hand in zip(self._bridged, frame.hands, strict=True)]
        sigmas = [hand.joint_sigma_m for hand in solved if hand.joint_sigma_m is not None]
        self._sigmas_mm += [1000 * float(np.median(sigma)) for sigma in sigmas]
        self._keep_reasons(frame)
        new = [warning for warning in frame.warnings if warning not in self.warnings]
        self.warnings += new
        return new

    def check_any(self) -> None:
        """Raise if nothing at all came of a take: the first lost image, or why no hand was solved.

        Raises: FileNotFoundError, ValueError.
        """
        if self.solved:
            return
        if self._problem is not None:
            raise self._problem
        if self._seen_by < 2:
            raise ValueError(
                f"no hand could be reconstructed: at least two views must see it; at most {self._seen_by} of "
                f"{self._take.rig.num_views} do. Add boxes for more views"
            )
        assert self._best is not None
        raise ValueError(f"no hand could be reconstructed: {self._best.reason}")

    def write(self, timings_s: Mapping[str, float], about: Mapping[str, Any]) -> Path:
        """Write the file, whole or not at all. `about` says what the engine was."""
        content = {
            "timings_s": timings_s,
            "reprojection": self.reprojection(),
            **about,
            "warnings": self.warnings,
            "cameras": self._take.rig.names,
            "hands": self._take.hand_names,
            "num_frames": self.frames,
            "frames_per_second": self._frames_per_second(),
            "num_hands": self.hands,
            "solved_hands": self.solved,
            "bridged_frames": dict(zip(self._take.hand_names, self._bridged, strict=True)),
            "median_joint_sigma_mm": float(np.median(self._sigmas_mm)) if self._sigmas_mm else None,
            "failed_frames": self.failed_frames,
            "versions": versions(),
        }
        head = json.dumps(_plain(content), indent=1, allow_nan=False)
        self._entries.seek(0)
        with whole_file(self.path) as temporary, temporary.open("w", encoding="utf-8") as stream:
            stream.write(head.removesuffix("\n}") + ',\n "frames": [')
            for line in self._entries:
                stream.write(line)
            stream.write("\n ]\n}")
        return self.path

    def close(self) -> None:
        """Let the gathered frames go; the file stays."""
        self._entries.close()

    def _keep_reasons(self, frame: Frame) -> None:
        """Remember what is said if the take ends without any hand."""
        needed = (problem.error for problem in frame.problems if problem.needed)
        self._problem = self._problem or next(needed, None)
        seen = np.isfinite(frame.boxes_px).all(-1)
        if frame.keypoints_px is not None:
            seen |= np.isfinite(frame.keypoints_px).all(-1).any(-1)
        self._seen_by = max(self._seen_by, int(seen.sum(-1).max(initial=0)))
        for hand in frame.hands:
            if self._best is None or hand.view_mask.sum() > self._best.view_mask.sum():
                self._best = hand

    def _frames_per_second(self) -> float | None:
        """Return the usual rate, None where the frames' times are not known."""
        steps = np.diff(self._times)
        steps = steps[np.isfinite(steps) & (steps > 0)]
        return float(1 / np.median(steps)) if steps.size else None

    @property
    def num_cameras(self) -> int:
        """How many cameras the take has."""
        return self._take.rig.num_views

    def reprojection(self) -> dict[str, Any]:
        """Return what the errors in the photographs are so far, and against what."""
        errors = np.stack(self._errors) if self._errors else np.zeros((0, self._take.rig.num_views))
        seen = errors[np.isfinite(errors)]
        medians = {
            camera: float(np.median(column[np.isfinite(column)]))
            for camera, column in zip(self._take.rig.names, errors.T, strict=True)
            if np.isfinite(column).any()
        }
        return {
            "against": self._against,
            "mean_px": float(seen.mean()) if seen.size else None,
            "median_px": float(np.median(seen)) if seen.size else None,
            "median_px_by_camera": medians,
            "views_used": self._views_used,
        }


def versions() -> dict[str, str]:
    """Return the versions that matter for repeating a run."""
    import flax
    import jax

    import poem_jax

    return {
        "poem_jax": poem_jax.__version__,
        "jax": jax.__version__,
        "flax": flax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
    }


def _entry(frame: Frame, take: Take) -> dict[str, Any]:
    """Say in plain types what came of a frame."""
    entry: dict[str, Any] = {"frame": frame.name}
    if frame.time_s is not None:
        entry["time_s"] = frame.time_s
    if frame.problems:
        entry["image_problems"] = [str(problem.error) for problem in frame.problems]
    pairs = zip(take.hand_names, frame.hands, strict=True)
    return {**entry, "hands": [_hand_entry(name, hand, take.rig) for name, hand in pairs]}


def _hand_entry(name: str, hand: HandResult, rig: Rig) -> dict[str, Any]:
    used = [camera for camera, seen in zip(rig.names, hand.view_mask, strict=True) if seen]
    entry: dict[str, Any] = {"hand": name, "valid": hand.reason is None, "views_used": used}
    if hand.reason is not None:
        return {**entry, "reason": hand.reason}
    if hand.bridged:
        entry["bridged"] = True
    entry["reprojection_px"] = _by_camera(rig, hand.reprojection_px)
    entry["joints_shown"] = _by_camera(rig, hand.joints_shown)
    if hand.joint_sigma_m is not None:
        entry["joint_sigma_mm"] = (1000 * hand.joint_sigma_m).astype(float).round(2).tolist()
    return entry


def _by_camera(rig: Rig, values: Float[Array, " view"]) -> dict[str, float]:
    pairs = zip(rig.names, values, strict=True)
    return {camera: float(value) for camera, value in pairs if np.isfinite(value)}


def _plain(content: Any) -> Any:
    """Return content in the types of JSON; what is not finite becomes None, so that every parser reads it."""
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    if isinstance(content, float | np.floating):
        return float(content) if np.isfinite(content) else None
    return str(content) if isinstance(content, os.PathLike) else content
