"""The stage `smooth`: hands that tremble less, and stay where they are not seen for a moment.

`causal` looks back only and gives every frame on at once, as a live picture needs it
(`fitting.causal`). `offline` goes half of the way between that filter run forwards and the same filter run
backwards over the next frames: what one is late the other is early. A hand that is not seen for a short time
is bridged: offline it goes the way between the moments before and after, in a live picture it stays where it
was. Longer gaps stay empty.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.frame_times import timed
from poem_jax.capture.jitter import Jitter
from poem_jax.capture.take import Take
from poem_jax.fitting.causal import CausalFilter, FilterConfig
from poem_jax.fitting.moving_hands import MeshHand, ModelHand, MovingHand
from poem_jax.hand.model import HandModel
from poem_jax.hand.pair import Hands
from poem_jax.hand.topology import NUM_VERTICES, ROOT_JOINT
from poem_jax.typing import Array

FILTER = FilterConfig()
"""Of a live picture; offline the same runs forwards and backwards."""

_AHEAD, _TOGETHER = 8, 4
"""Frames that are looked ahead at, and that are smoothed at a time: so many are held, with their images."""
_ROUNDING_S = 1e-6
MAX_BRIDGE_S = 1.0


@dataclass(frozen=True)
class Smoothing:
    """What is done to the hands of a take."""

    mode: Literal["off", "offline", "causal"] = "off"
    bridge_s: float = 0.2
    """A hand is bridged where it was last seen so many seconds ago at most; 0 = never."""

    def __post_init__(self) -> None:
        if not 0 <= self.bridge_s <= MAX_BRIDGE_S:
            raise ValueError(
                f"a hand can be bridged for 0 to {MAX_BRIDGE_S:g} s, since frames wait with their images for "
                f"so long; got {self.bridge_s}"
            )


OFF = Smoothing()


class _Moment(NamedTuple):
    """A frame on its way through the stage; one entry a hand, None = not seen."""

    time_s: float
    frame: Frame
    hands: Sequence[MovingHand | None]
    """Smoothed, as far as they are by now."""
    noise_m: Sequence[float | None] = ()
    """Of what was seen."""


class Smoother:
    """The stage for one take, and what it did."""

    def __init__(self, take: Take, smoothing: Smoothing, models: Hands | None) -> None:
        """Prepare it.

        Args:
            take: The sides of its hands.
            smoothing: What to do.
            models: The hand models that belong to pose, shape and place, where an engine gives them; None =
                it gives none.
        """
        self._smoothing = smoothing
        self._models = [None if models is None else models.of(side) for side in take.hand_sides]
        self._jitter = Jitter(len(self._models))
        self.done: dict[str, Any] = {"mode": smoothing.mode}
        """For the report: how, hands that were bridged, and how much they tremble before and after."""

    def smooth(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Smooth the hands of a stream, and bridge them where they are not seen for a short time.

        Args:
            frames: With results.

        Returns: the stream, bridged hands marked.

        Raises:
            ValueError: The times of the frames do not grow, or some frames have none.
        """
        smoothing = self._smoothing
        if smoothing.mode == "off":
            yield from frames
            return
        moments = self._moments(frames)
        if smoothing.mode == "causal":
            moments = _held(_forwards(moments, FILTER), smoothing.bridge_s)
        else:
            moments = _bridged(_both_ways(moments), smoothing.bridge_s)
        bridged = 0
        for moment in moments:
            hands = tuple(map(_result, moment.frame.hands, moment.hands))
            bridged += sum(hand.bridged for hand in hands)
            for index, (before, after) in enumerate(zip(moment.frame.hands, hands, strict=True)):
                was = before.joints_world if before.alone_world is None else before.alone_world
                self._jitter.add(index, moment.time_s, was, after.joints_world)
            self.done |= {
                "bridge_s": smoothing.bridge_s,
                "bridged_hands": bridged,
                **self._jitter.figures(),
            }
            yield moment.frame._replace(hands=hands)

    def _moments(self, frames: Iterable[Frame]) -> Iterator[_Moment]:
        for time_s, frame in timed(frames):
            hands = [_moving(hand, model) for hand, model in zip(frame.hands, self._models, strict=True)]
            yield _Moment(time_s, frame, hands, [_noise_m(hand) for hand in frame.hands])


def _forwards(moments: Iterable[_Moment], config: FilterConfig) -> Iterator[_Moment]:
    """Run the filter over a stream, a filter a hand; forget what it took the noise to be."""
    filters: list[CausalFilter] = []
    for moment in moments:
        filters = filters or [CausalFilter(config) for _ in moment.hands]
        hands = [
            None if hand is None else one.update(moment.time_s, hand, noise)
            for one, hand, noise in zip(filters, moment.hands, moment.noise_m, strict=True)
        ]
        yield moment._replace(hands=hands, noise_m=[one.noise_m for one in filters])


def _both_ways(moments: Iterable[_Moment]) -> Iterator[_Moment]:
    """Go half of the way between the filter run forwards and that run backwards over the next frames."""
    waiting: list[_Moment] = []
    seen: list[Sequence[MovingHand | None]] = []

    def kept() -> Iterator[_Moment]:
        for moment in moments:
            seen.append(moment.hands)
            yield moment

    for moment in _forwards(kept(), FILTER):
        waiting.append(moment)
        if len(waiting) == _TOGETHER + _AHEAD:
            yield from _met(waiting, seen)[:_TOGETHER]
            del waiting[:_TOGETHER], seen[:_TOGETHER]
    yield from _met(waiting, seen)


def _met(forwards: Sequence[_Moment], seen: Sequence[Sequence[MovingHand | None]]) -> list[_Moment]:
    """Return the moments half of the way between forwards and backwards."""
    turned = (
        moment._replace(time_s=-moment.time_s, hands=hands)
        for moment, hands in zip(reversed(forwards), reversed(seen), strict=True)
    )
    backwards = reversed(list(_forwards(turned, FILTER)))
    return [
        one._replace(hands=tuple(map(_half_way, one.hands, other.hands)))
        for one, other in zip(forwards, backwards, strict=True)
    ]


def _half_way(one: MovingHand | None, other: MovingHand | None) -> MovingHand | None:
    return None if one is None else one.towards(other, 0.5)


def _held(moments: Iterable[_Moment], bridge_s: float) -> Iterator[_Moment]:
    """Let a hand that is not seen stay where it was, for a short time."""
    last: dict[int, tuple[float, MovingHand]] = {}
    for moment in moments:
        hands = list(moment.hands)
        for index, hand in enumerate(hands):
            if hand is not None:
                last[index] = moment.time_s, hand
            elif index in last and moment.time_s - last[index][0] <= bridge_s + _ROUNDING_S:
                hands[index] = last[index][1]
        yield moment._replace(hands=hands)


def _bridged(moments: Iterable[_Moment], bridge_s: float) -> Iterator[_Moment]:
    """Let a hand that is not seen for a short time go the way between the moments before and after.

    Frames are held until that is known.
    """
    waiting: list[_Moment] = []
    last: dict[int, tuple[float, MovingHand]] = {}
    open_since: dict[int, int] = {}
    for moment in moments:
        for index, hand in enumerate(moment.hands):
            begin = last.get(index)
            if hand is not None:
                for place in range(open_since.pop(index, len(waiting)), len(waiting)):
                    assert begin is not None
                    waiting[place] = _between(waiting[place], index, begin, (moment.time_s, hand))
                last[index] = moment.time_s, hand
            elif begin is not None and moment.time_s - begin[0] <= bridge_s + _ROUNDING_S:
                open_since.setdefault(index, len(waiting))
            else:
                open_since.pop(index, None)
                last.pop(index, None)
        waiting.append(moment)
        settled = min(open_since.values(), default=len(waiting))
        yield from waiting[:settled]
        del waiting[:settled]
        open_since = {index: place - settled for index, place in open_since.items()}
    yield from waiting


def _between(
    moment: _Moment, index: int, begin: tuple[float, MovingHand], end: tuple[float, MovingHand]
) -> _Moment:
    """Put one hand of a moment where it is on the way from an earlier one to a later one."""
    share = (moment.time_s - begin[0]) / (end[0] - begin[0])
    hands = list(moment.hands)
    hands[index] = begin[1].towards(end[1], share)
    return moment._replace(hands=hands)


def _moving(hand: HandResult, model: HandModel | None) -> MovingHand | None:
    """Return a result as a hand that can move, in float64."""
    if hand.joints_world is None:
        return None
    joints, expected = np.asarray(hand.joints_world, np.float64), hand.expected_world
    if hand.pose is not None and model is not None:
        offsets = None if expected is None else expected - joints
        return ModelHand.posed(model, hand.pose, hand.shape, hand.translation, offsets)
    carried = [np.asarray(hand.vertices_world), np.asarray(hand.root_world)[None]]
    carried += [] if expected is None else [expected]
    return MeshHand(joints, np.concatenate(carried).astype(np.float64))


def _noise_m(hand: HandResult) -> float | None:
    """Return the engine's own uncertainty of a joint's coordinate, root mean square, metres."""
    sigma = hand.joint_sigma_m
    return None if sigma is None else float(np.sqrt(np.mean(np.square(sigma))))


def _result(seen: HandResult, moved: MovingHand | None) -> HandResult:
    """Return a result with the hand where it has moved to; one that was not seen there is marked."""
    if moved is None:
        return seen
    if seen.joints_world is None:
        seen = HandResult(np.zeros_like(seen.view_mask), bridged=True)
    if isinstance(moved, ModelHand):
        return seen._replace(
            vertices_world=_single(moved.mesh.vertices),
            joints_world=_single(moved.mesh.joints),
            root_world=_single(moved.mesh.joints[ROOT_JOINT]),
            pose=_single(moved.pose),
            shape=_single(moved.shape),
            translation=_single(moved.translation),
            expected_world=None if moved.expected is None else _single(moved.expected),
        )
    assert isinstance(moved, MeshHand)
    vertices, root, expected = np.split(moved.points, [NUM_VERTICES, NUM_VERTICES + 1])
    return seen._replace(
        vertices_world=_single(vertices),
        joints_world=_single(moved.joints),
        root_world=_single(root[0]),
        expected_world=_single(expected) if len(expected) else None,
    )


def _single(array: Array) -> Array:
    return array.astype(np.float32)
