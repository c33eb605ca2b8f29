"""Which engine to take for a capture: both are judged by views that neither of them was given.

A fit makes its reprojection error as small as it can, so that the error in its own views says nothing of how
far it is to be trusted. In a few frames, spread over the take, one view after the other is therefore left
out: each engine finds the hands from the rest, and the distance of its joints from the key points in the view
left out counts. Where no hand is seen by three views, the engines' own uncertainties are compared.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.take import Take
from poem_jax.data.lens import project_raw
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Bool, Float

SAMPLE_FRAMES = 8
"""Frames that are tried, and hands found twice over: once by each engine."""
_LOOKED_THROUGH = 512
"""Frames of a take among which those to try are chosen; reading on may mean to decode videos."""
_VIEWS_TO_PLACE, _VIEWS_TO_TEST = 2, 3

Find = Callable[[Iterable[Frame], Take], Iterable[Frame]]
"""An engine on trial: frames in, the same with hands out, in order; it judges neither rig nor boxes."""


class EngineChoice(NamedTuple):
    """The engine that was taken, and why."""

    engine: str
    by: str
    """"views left out", "uncertainty", "only one can run" or "as asked"."""
    why: str
    """One sentence."""
    figures: Mapping[str, Mapping[str, float | None]] = {}
    """By engine: `left_out_px`, median distance of its joints from the key points in views that it was not
    given (pixels of the photographs), or `sigma_mm`, median standard deviation of a coordinate of a joint, by
    its own account; None = it found less than half of the hands, or does not know. And `hands_lost`, a
    share."""
    frames: tuple[str, ...] = ()
    """Names of the frames that were tried."""

    def as_report(self) -> dict[str, Any]:
        """Return what `report.json` says of the choice."""
        return self._asdict()


class Trial(NamedTuple):
    """A frame, and the view that is kept from the engines."""

    frame: Frame
    view: int


class Sample(NamedTuple):
    """A few frames of a take."""

    frames: list[Frame]
    """Those that an engine can be tried on."""
    keypoints: bool
    """Whether the take comes with key points."""
    images: bool
    """Whether there are images."""


def sample_frames(take: Take) -> tuple[Sample, Take]:
    """Choose the frames to try an engine on, spread over the take, and give the whole take back.

    Frames in which three views see a hand come before those where two do. Of a stream that can be gone
    through only once the first frames are taken; they are put back in front of it.
    """
    if isinstance(take.frames, Sized):
        return _sample(islice(take.frames, _LOOKED_THROUGH)), take
    stream = iter(take.frames)
    head = list(islice(stream, SAMPLE_FRAMES))
    return _sample(head), take._replace(frames=chain(head, stream))


def _sample(frames: Iterable[Frame]) -> Sample:
    by_views: dict[int, list[Frame]] = {_VIEWS_TO_PLACE: [], _VIEWS_TO_TEST: []}
    keypoints = images = False
    for frame in frames:
        keypoints |= frame.keypoints_px is not None
        images |= any(image is not None for image in (*frame.image_files, *frame.images))
        most = int(seen_hands(frame).sum(-1).max(initial=0))
        for views, kept in by_views.items():
            if most >= views:
                kept.append(frame)
    kept = by_views[_VIEWS_TO_TEST] or by_views[_VIEWS_TO_PLACE]
    places = np.linspace(0, len(kept) - 1, min(SAMPLE_FRAMES, len(kept))).round().astype(int)
    return Sample([kept[place] for place in places], keypoints, images)


def seen_hands(frame: Frame) -> Bool[Array, "hand view"]:
    """Tell which views see which hands, by their key points where there are any, else by their boxes."""
    seen = np.isfinite(frame.boxes_px).all(-1)
    if frame.keypoints_px is not None:
        seen &= np.isfinite(frame.keypoints_px).all(-1).any(-1)
    return seen


def choose_engine(take: Take, frames: Sequence[Frame], engines: Mapping[str, Find]) -> EngineChoice:
    """Try all engines on the same frames and take the one that is right more often.

    Args:
        take: Cameras and sides of the hands.
        frames: Of `sample_frames`, with key points.
        engines: By name.
    """
    trials = plan_trials(frames)
    names = tuple(frame.name for frame in frames)
    if trials:
        figures = _errors_in_views_left_out(take, trials, engines)
        engine, why = _least(figures, "left_out_px", "px from key points in views it was not given")
        return EngineChoice(engine, "views left out", why, figures, names)
    figures = {name: _own_uncertainty(take, frames, find) for name, find in engines.items()}
    engine, why = _least(figures, "sigma_mm", "mm uncertainty of a joint by its own account")
    why += "; no hand is seen by three views, so that none could be left out to test it"
    return EngineChoice(engine, "uncertainty", why, figures, names)


def plan_trials(frames: Sequence[Frame], most: int = SAMPLE_FRAMES) -> list[Trial]:
    """Say which view is left out of which frame: each in turn, of the views that see a hand with two others.

    With fewer frames than `most` some come again with another view left out.
    """
    views = [_can_be_left_out(frame) for frame in frames]
    trials: list[Trial] = []
    for turn in range(most):
        for index, (frame, candidates) in enumerate(zip(frames, views, strict=True)):
            if turn < len(candidates) and len(trials) < most:
                view = candidates[(index + turn) % len(candidates)]
                trials.append(Trial(frame, int(view)))
    return trials


def _can_be_left_out(frame: Frame) -> Array:
    seen = seen_hands(frame)
    return np.flatnonzero(seen[seen.sum(-1) >= _VIEWS_TO_TEST].any(0))


def _without(frame: Frame, view: int) -> Frame:
    """Return what is left of a frame for an engine that is not given a view."""
    assert frame.keypoints_px is not None
    boxes_px, keypoints_px = frame.boxes_px.copy(), frame.keypoints_px.copy()
    boxes_px[:, view] = keypoints_px[:, view] = np.nan
    files = tuple(None if at == view else file for at, file in enumerate(frame.image_files))
    images = tuple(None if at == view else image for at, image in enumerate(frame.images))
    return frame._replace(boxes_px=boxes_px, keypoints_px=keypoints_px, image_files=files, images=images)


def _errors_in_views_left_out(
    take: Take, trials: Sequence[Trial], engines: Mapping[str, Find]
) -> dict[str, dict[str, float | None]]:
    distances: dict[str, list[Array]] = {name: [] for name in engines}
    lost: dict[str, list[bool]] = {name: [] for name in engines}
    # Frames that lack the same view go together, so that nothing learned in one frame, such as the shape of
    # the hand, has seen that view in another.
    for view in sorted({trial.view for trial in trials}):
        given = [trial.frame for trial in trials if trial.view == view]
        held = [_without(frame, view) for frame in given]
        found = {name: list(find(iter(held), take)) for name, find in engines.items()}
        for index, frame in enumerate(given):
            for hand in np.flatnonzero(seen_hands(frame)[:, view] & (seen_hands(held[index]).sum(-1) > 1)):
                results = {name: frames[index].hands[hand] for name, frames in found.items()}
                seen_px = frame.keypoints_px[hand, view]  # pyright: ignore[reportOptionalSubscript]
                for name, expected in _expected_points(results).items():
                    distances[name].append(_distances_px(expected, seen_px, take.rig, view))
                    lost[name].append(expected is None)
    return {
        name: {"left_out_px": _median(distances[name]), "hands_lost": float(np.mean(lost[name]))}
        for name in engines
    }


def _expected_points(results: Mapping[str, HandResult]) -> dict[str, Float[Array, "21 3"] | None]:
    """Return where the detector of the key points should see each engine's joints; None = no hand.

    An engine that allows for the detector's habits knows how far from a joint it puts its point. The others
    get the same shift, so that what is compared is the hands.
    """
    shift = next(
        (
            hand.expected_world - hand.joints_world
            for hand in results.values()
            if hand.expected_world is not None and hand.joints_world is not None
        ),
        0.0,
    )
    return {
        name: None if hand.joints_world is None else hand.joints_world + shift
        for name, hand in results.items()
    }


def _distances_px(
    points_world: Float[Array, "21 3"] | None, seen_px: Float[Array, "21 2"], rig: Rig, view: int
) -> Float[Array, " joint"]:
    """Return the distances of the points that are seen; infinite where there is no hand, or not in front."""
    seen = np.isfinite(seen_px).all(-1)
    if points_world is None:
        return np.full(seen.sum(), np.inf)
    projected, _ = project_raw(rig, view, points_world)
    distances = np.linalg.norm(projected - seen_px, axis=-1)[seen]
    return np.where(np.isfinite(distances), distances, np.inf)


def _own_uncertainty(take: Take, frames: Sequence[Frame], find: Find) -> dict[str, float | None]:
    """Return how far an engine trusts itself where the whole of each frame is given to it."""
    sigmas, lost = [np.full(0, np.inf)], []
    for frame, found in zip(frames, find(iter(frames), take), strict=True):
        for hand in np.flatnonzero(seen_hands(frame).sum(-1) > 1):
            sigma = found.hands[hand].joint_sigma_m
            sigmas.append(np.full(1, np.inf) if sigma is None else np.asarray(sigma))
            lost.append(found.hands[hand].joints_world is None)
    median_m = _median(sigmas)
    share = float(np.mean(lost)) if lost else 1.0
    return {"sigma_mm": None if median_m is None else 1000 * median_m, "hands_lost": share}


def _median(parts: Sequence[Array]) -> float | None:
    """Return the median of all numbers; None where that is not finite."""
    values = np.concatenate(parts) if parts else np.zeros(0)
    median = float(np.median(values)) if values.size else np.inf
    return median if np.isfinite(median) else None


def _least(figures: Mapping[str, Mapping[str, float | None]], figure: str, meaning: str) -> tuple[str, str]:
    """Return the engine with the least figure, and a sentence that says so."""
    given = {name: row[figure] for name, row in figures.items()}
    values = {name: np.inf if value is None else value for name, value in given.items()}
    best = min(values, key=lambda name: values[name])
    if np.isinf(values[best]):
        return best, "neither engine found half of the hands that were tried, or says how sure it is"
    told = [f"{name} {'none' if np.isinf(value) else f'{value:.1f}'}" for name, value in values.items()]
    return best, f"{', '.join(told)} ({meaning})"
